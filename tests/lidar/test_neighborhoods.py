import itertools

import numpy as np
import plane_world

from lvba.lidar import range_errors, scan_evidence
from lvba.lidar.bundle_adjustment import find_planes
from lvba.lidar.neighborhoods import neighborhoods
from lvba.lidar.range_errors import Beams
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import View


def test_planes_beside_each_other_are_together_and_all_neighborhoods_are_as_large():
    center = np.random.default_rng(3).uniform(0, [40, 10, 3], (1000, 3))
    number = neighborhoods(center, 4)
    count = np.bincount(number)
    assert len(count) == 16
    assert count.max() - count.min() <= 1
    boxes = [np.ptp(center[number == each], axis=0) for each in range(16)]
    assert np.median([box[0] * box[1] for box in boxes]) < 40 * 10 / 16 * 1.2
    for one, other in itertools.combinations(range(16), 2):
        a, b = center[number == one], center[number == other]
        assert ((a.max(axis=0) < b.min(axis=0)) | (b.max(axis=0) < a.min(axis=0))).any()


def test_few_planes_are_each_on_its_own():
    assert sorted(neighborhoods(np.random.default_rng(3).normal(size=(5, 3)), 6).tolist()) == [0, 1, 2, 3, 4]
    assert neighborhoods(np.zeros((0, 3)), 6).tolist() == []


def _uneven(points, seed):
    """Points of a scan whose ranges are off by some millimeters, in another way for each direction."""
    rng = np.random.default_rng(seed)
    ray, _ = range_errors.directions(points, np.zeros(3))
    waves = np.sin(ray @ rng.normal(0, 1.5, (3, 12)) + rng.uniform(0, 2 * np.pi, 12))
    return (points + ray * (0.01 * waves.sum(axis=1, keepdims=True) / np.sqrt(6))).astype(np.float32)


def test_numbers_are_as_uncertain_as_they_are_wrong_where_a_model_lacks_what_planes_share(monkeypatch):
    points, truth, _ = plane_world.recording("courtyard", scans=8, points=12000, seed=3)
    beams = Beams(np.zeros(3), np.array([0.0, 0.0, 1.0]), narrow=False)

    def off(halvings, seeds=range(8)):
        """By how many standard deviations the errors of a right sensor are, root mean square."""
        monkeypatch.setattr(scan_evidence, "_HALVINGS", halvings)
        squares = []
        for seed in seeds:
            scans = gather([_uneven(each, seed) for each in points])
            view = View.of(scans, truth, *find_planes(scans, truth))
            evidence = scan_evidence.evidence(view, range_errors.by_errors(beams, None), len(beams.names))
            squares.append((evidence.change / evidence.sigma) ** 2)
        return np.sqrt(np.mean(squares))

    alone, together = off(20), off(6)
    assert together < 0.85 * alone
    assert together < 2

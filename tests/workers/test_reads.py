"""How often a run reads and decodes each scan and each image, counted in the readers of files."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lvba import pipeline
from lvba.blocks import decoded_images, decoded_scans, split, survey
from lvba.blocks.split import SplitConfig
from lvba.io import images, pcd
from lvba.io.dataset import open_dataset
from lvba.pipeline import Config
from workers import local
from workers.store import ZarrStore

MOST_SCANS, MOST_IMAGES = 4, 1
"""Of a scan: what memory it takes (4 of all), survey (16 of all), errors of the sensor (28 of all), all else."""

MOST_OPENED = 20
"""Scans that are looked at when a recording is opened: whether their units and poses are as they should."""


@pytest.fixture
def reads(monkeypatch):
    """How often each file was decoded, by path."""
    counts = Counter()

    def counted(module, name):
        real = getattr(module, name)

        def read(path, *arguments, **options):
            counts[str(path)] += 1
            return real(path, *arguments, **options)

        monkeypatch.setattr(module, name, read)

    counted(pcd, "read_pcd")
    counted(images, "read_image")
    return counts


@pytest.mark.filterwarnings("error::RuntimeWarning")  # an overflow would be printed to users
@pytest.mark.parametrize(("size", "held"), [(0, local.HELD_BYTES), (10, 0)])
def test_frames_are_decoded_once_for_each_use(street_in_two, reads, tmp_path, monkeypatch, size, held):
    """Also where nothing stays in memory between steps, and by all parts together where there are two."""
    monkeypatch.setattr(local, "HELD_BYTES", held)
    monkeypatch.setattr(decoded_images, "PIECE_BYTES", 6 * 3 * 160 * 120)
    cut = SplitConfig(by="count", size=size, overlap=5) if size else SplitConfig(by="none")
    dataset = open_dataset(street_in_two)
    opened = Counter(reads)
    reads.clear()
    plan = pipeline.refine(dataset, replace(Config(), split=cut))
    store = ZarrStore(tmp_path)
    local.run(plan, store)
    names = [step.name for step in plan.steps.values()]
    assert len([name for name in names if name.startswith("photos-")]) > 2
    assert len(opened) <= MOST_OPENED, "to open a recording is to decode few scans"
    assert set(opened) <= set(dataset.scan_paths)
    assert set(opened.values()) == {1}
    scans, photos = ([reads[path] for path in paths] for paths in (dataset.scan_paths, dataset.image_paths))
    assert min(scans) >= 1
    assert max(scans) <= MOST_SCANS
    assert np.mean(scans) <= (MOST_SCANS if len(scans) <= 20 else 1 + 48 / len(scans))
    assert set(photos) == {MOST_IMAGES}  # every image is a keyframe here
    assert store[next(step.key for step in plan.steps.values() if step.name == "visual-gate")].scans.accepted


@pytest.mark.parametrize("held", [(3, 6), (0, 3)])
def test_of_dense_scans_all_but_the_map_reads_every_second_point(street_in_two, monkeypatch, held):
    """From pieces and from files alike."""
    dataset = open_dataset(street_in_two)
    monkeypatch.setattr(split, "ENOUGH_POINTS", survey.load_of(dataset).points_per_scan / 2)
    known = survey.survey(dataset, Config().lidar, Config().visual.keyframes)
    assert known.every == 2
    piece = decoded_scans.decode_scans(dataset, held, None, known)
    pieces = [(held, lambda: piece)]
    fewer, every = (
        decoded_scans.ScanReader(pieces, whole=dataset, all_points=each) for each in (False, True)
    )
    for scan in (0, 3, 5, 6):
        points = pcd.read_pcd(dataset.scan_paths[scan]).points
        np.testing.assert_array_equal(every(scan), points)
        np.testing.assert_array_equal(fewer.load([scan])[0], points[::2])
        assert fewer.load([scan])[0].flags.c_contiguous
        assert len(fewer.intensities([scan])) == len(points[::2])


def test_a_scan_that_no_piece_holds_is_read_from_its_file(street_in_two):
    dataset = open_dataset(street_in_two)
    piece = decoded_scans.decode_scans(dataset, (3, 6))
    reader = decoded_scans.ScanReader([((3, 6), lambda: piece)], whole=dataset)
    for scan in (0, 3, 5, 6):
        np.testing.assert_array_equal(reader(scan), pcd.read_pcd(dataset.scan_paths[scan]).points)
    with pytest.raises(IndexError, match="no piece holds scan 7"):
        decoded_scans.ScanReader([((3, 6), lambda: piece)], first=4)(3)

"""How deep beams go into surfaces: by points that spread farther behind a plane than before it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import beam_depth, scan_evidence
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.range_errors import OFFSET, Beams, by_errors
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import View

BEAMS = Beams(np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.0, 1.0]), False)
NOISE = 0.02


def hall(depth, seed=0, each=400):
    """Scans from near the middle of a cube of 12 m whose six walls beams go into, exponentially; (6,) m, mean of each."""
    rng = np.random.default_rng(seed)
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    poses = geometry.exp(rng.normal(size=(8, 6)) * [0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
    walls = np.repeat(np.arange(6, dtype=np.int32), each)
    points = []
    for pose in poses:
        origin = geometry.transform_points(pose, BEAMS.position[None])[0]
        place = 6.0 * normals[walls] + rng.uniform(-5, 5, (len(walls), 3)) * (normals[walls] == 0)
        ray, distance = place - origin, np.linalg.norm(place - origin, axis=1)
        behind = rng.normal(0, NOISE, len(walls)) + rng.exponential(1.0, len(walls)) * np.array(depth)[walls]
        hit = origin + ray * (1 + behind / distance)[:, None]
        points.append(geometry.transform_points(geometry.inverse(pose), hit).astype(np.float32))
    planes = Planes(
        center=6.0 * normals,
        normal=normals,
        eigenvalues=np.tile([NOISE**2, 1.0, 1.0], (6, 1)),
        axes=np.stack([np.linalg.svd(n[None])[2].T for n in normals]),
        count=np.ones(6, np.int64),
        scans=np.full(6, 8, np.int32),
        size=np.ones(6),
        sigma_offset=np.full(6, 1e-3),
        unevenness=np.zeros(6),
    )
    scans = gather(points)
    return View.of(
        scans, poses, planes, PlanePoints(scans.points, np.tile(walls, 8), scans.offsets), BEAMS.position
    )


def test_planes_that_beams_go_into_and_how_deep():
    true = np.array([0.05, 0.0, 0.03, 0.0, 0.04, 0.0])
    depths = beam_depth.of_planes(hall(true), BEAMS.position)
    np.testing.assert_allclose(depths.mean, true, atol=0.006)
    squares, points = depths.squares
    assert np.sqrt(squares / points) == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.1)
    np.testing.assert_array_equal(depths.of_points(np.array([-1, 1])), [0.0, depths.mean[1]])


@pytest.mark.parametrize("noisy", [0, 3])
def test_noise_of_any_size_is_no_depth(noisy):
    """As that of depth cameras, larger far away."""
    view = hall(np.zeros(6))
    points = view.scans.points.copy()
    points[view.labels.plane == noisy] += np.random.default_rng(1).normal(
        0, 0.1, ((view.labels.plane == noisy).sum(), 3)
    )
    depths = beam_depth.of_planes(replace(view, scans=replace(view.scans, points=points)), BEAMS.position)
    assert not depths.mean.any()


def test_as_many_planes_with_a_long_side_toward_the_sensor_are_no_depth():
    """As mirrors, edges and the steps of a depth camera make them."""
    view = hall([0.05, 0.05, 0.05, 0.0, 0.0, 0.0])
    toward = np.isin(view.labels.plane, [3, 4, 5])
    nearer = np.random.default_rng(2).exponential(0.05, toward.sum())
    points = view.scans.points.copy()
    ray = points[toward] - BEAMS.position
    points[toward] -= (ray * (nearer / np.linalg.norm(ray, axis=1))[:, None]).astype(np.float32)
    depths = beam_depth.of_planes(replace(view, scans=replace(view.scans, points=points)), BEAMS.position)
    assert not depths.mean.any()


def test_a_small_part_of_such_planes_is_seen_where_it_was_before():
    """7 % of the points: more than that must show them first, half of it later."""
    view = hall([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    labels = np.where(np.arange(len(view.labels.plane)) % 5 < 3, -1, view.labels.plane)
    labels = np.where(view.labels.plane == 0, labels, view.labels.plane)
    view = replace(view, labels=replace(view.labels, plane=labels))
    first, later = (beam_depth.of_planes(view, BEAMS.position, seen) for seen in (False, True))
    assert not first.mean.any()
    assert later.mean[0] == pytest.approx(0.05, abs=0.006)
    assert later.mean[1:].max() < 0.02


@pytest.mark.parametrize(("toward", "seen"), [(0, True), (4, True), (5, False)])
def test_a_small_part_is_seen_where_planes_have_one_side_alone(toward, seen):
    """Twenty planes of 5 % of the points that beams go into, and some with a long side toward the sensor."""
    rng = np.random.default_rng(4)
    deep, plain = 20, 20
    walls = np.repeat(
        np.arange(deep + toward + plain, dtype=np.int32), [400] * (deep + toward) + [7600] * plain
    )
    side = np.concatenate([np.ones(deep), -np.ones(toward), np.zeros(plain)])[walls]
    along = rng.normal(0, NOISE, len(walls)) + side * rng.exponential(0.06, len(walls))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beam_depth, "_along", lambda view, position: (walls, along))
        depths = beam_depth.of_planes(SimpleNamespace(planes=range(walls[-1] + 1)), BEAMS.position)
    assert bool(depths.mean.any()) == seen
    if seen:
        assert np.sqrt(np.mean(depths.mean[:deep] ** 2)) == pytest.approx(0.06, rel=0.1)


def test_where_no_point_is_on_a_plane_there_is_no_depth():
    view = hall(np.zeros(6), each=2)
    depths = beam_depth.of_planes(view, BEAMS.position)
    assert not depths.mean.any()
    assert depths.squares.tolist() == [0.0, 0.0]


def test_depths_are_not_taken_for_an_offset():
    """Half of the walls let beams in: taken for plain ones, they tell of an offset that is not there."""
    view = hall([0.05, 0.0, 0.05, 0.05, 0.0, 0.0], seed=3, each=2000)
    depths = beam_depth.of_planes(view, BEAMS.position)
    own = by_errors(BEAMS)
    deep = beam_depth.by_depth(BEAMS, depths.of_points(view.labels.plane))
    names, offset = len(BEAMS.names), BEAMS.names.index(OFFSET)
    alone = scan_evidence.evidence(view, own, names)
    beside = scan_evidence.evidence(
        view, lambda points: np.concatenate([own(points), deep(points)], axis=1), names + 1
    )
    assert alone.change[offset] > 0.02
    assert abs(beside.change[offset]) < 0.005
    assert beside.change[names] == pytest.approx(1.0, abs=0.2)

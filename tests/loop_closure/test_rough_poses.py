"""Rough poses that are too far off to start from: noticed where they are, not where they are not, and replaced."""

import numpy as np
import plane_world
import pytest

from lvba import geometry
from lvba.io.dataset import load_scans, open_dataset
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import LidarConfig
from lvba.loop_closure import rough_motions, rough_poses, scan_steps
from lvba.loop_closure.rough_poses import RoughError
from lvba.loop_closure.surfel_icp import Target
from lvba.simulate import simulate
from lvba.simulate.disturbances import Disturbances
from lvba.steps import trajectory_jumps
from lvba.trajectory import Trajectory, pose_error

SCANS = 26


@pytest.fixture(scope="module")
def courtyard():
    """Scans, true poses, rough poses as an odometry leaves them, and the surfels of each scan."""
    scans, truth, rough = plane_world.recording("courtyard", scans=SCANS, points=12000)
    return scans, truth, rough, rough_poses.surfels_of(scans)


@pytest.fixture(scope="module")
def refined_without(courtyard):
    """The bundle adjustment from rough poses in which nothing jumps."""
    scans, _, rough, _ = courtyard
    return bundle_adjustment.refine(scans, rough)


@pytest.fixture(scope="module")
def mended(courtyard):
    """What becomes of rough poses with jumps: where to start from, and the bundle adjustment from there."""
    scans, _, rough, surfels = courtyard
    start = rough_poses.start(scans, surfels, with_jumps(rough))
    return start, bundle_adjustment.refine(scans, start.world_from_scan)


def jumped(poses, after, tangent):
    """The poses, all of them after `after` moved by a tangent about the first of these."""
    moved = poses.copy()
    pivot = poses[after + 1]
    motion = pivot @ geometry.exp(np.array(tangent)) @ geometry.inverse(pivot)
    moved[after + 1 :] = motion @ poses[after + 1 :]
    return moved


JUMPS = ((8, [0.0, 0.0, 0.035, 0.9, -0.4, 0.1]), (17, [0.0, 0.02, -0.03, -0.6, 0.8, 0.0]))


def with_jumps(poses):
    for after, tangent in JUMPS:
        poses = jumped(poses, after, tangent)
    return poses


def test_an_odometry_as_they_are_is_not_contradicted(courtyard):
    _, truth, rough, surfels = courtyard
    for poses in (truth, rough, plane_world.drift(truth, 5, 0.25, 0.6)):
        assert len(rough_motions.contradicted(surfels, poses)) == 0


def test_jumps_are_noticed_where_they_are(courtyard):
    _, _, rough, surfels = courtyard
    assert rough_motions.contradicted(surfels, with_jumps(rough)).tolist() == [after for after, _ in JUMPS]


def test_jumps_are_taken_out_and_the_bundle_adjustment_ends_where_it_does_without(
    courtyard, refined_without, mended
):
    _, truth, rough, surfels = courtyard
    wrong = with_jumps(rough)
    start, refined = mended[0], mended[1].world_from_scan
    assert np.array_equal(start.world_from_scan[0], wrong[0])
    assert start.error.wrong_after.tolist() == [after for after, _ in JUMPS]
    assert pose_error(start.world_from_scan, truth).ate_m < 0.05 < pose_error(wrong, truth).ate_m
    without = pose_error(refined_without.world_from_scan, truth)
    assert pose_error(refined, truth).ate_m < 1.5 * without.ate_m
    assert len(start.judged(surfels, wrong, refined).left_after) == 0


def test_poses_that_came_of_the_scans_are_no_second_witness_beside_them(courtyard, refined_without, mended):
    """Registered poses agree with refined ones to a millimeter: as an odometry, they would hold their own errors."""
    scans, _, rough, _ = courtyard
    wrong = with_jumps(rough)
    start, held = mended
    odometry = rough_poses.odometry_of(wrong, start.error, start.world_from_scan, LidarConfig())
    assert odometry.jumps.tolist() == [after for after, _ in JUMPS]
    refined = bundle_adjustment.refine(scans, start.world_from_scan, odometry=odometry)
    dependence = [np.median(each.odometry_dependence) for each in (refined_without, refined, held)]
    assert dependence[1] == pytest.approx(dependence[0], rel=0.2)
    assert dependence[2] > 0.4
    # within the deviations promised, the odometry's errors decide nothing
    apart = geometry.log(geometry.inverse(refined_without.world_from_scan) @ refined.world_from_scan)
    assert np.abs(apart[:, 3:]).max() < 2e-4


def test_without_an_error_the_odometry_is_as_the_settings_have_it(courtyard):
    _, _, rough, _ = courtyard
    odometry = rough_poses.odometry_of(rough, None, rough, LidarConfig())
    assert not len(odometry.jumps)
    assert 1 / np.sqrt(np.diag(odometry.information[3])) == pytest.approx([0.01] * 3 + [0.05] * 3)


def test_an_odometry_that_is_decimeters_off_at_every_step_is_replaced(
    courtyard, refined_without, monkeypatch
):
    scans, truth, _, surfels = courtyard
    rng = np.random.default_rng(3)
    steps = geometry.inverse(truth[:-1]) @ truth[1:]
    steps = steps @ geometry.exp(rng.normal(size=(len(steps), 6)) * ([0.03] * 3 + [0.3] * 3))
    wrong = [truth[0]]
    for step in steps:
        wrong.append(wrong[-1] @ step)
    wrong = np.array(wrong)
    assert len(rough_motions.contradicted(surfels, wrong))
    solved, members = rough_poses._Group.solved, []
    monkeypatch.setattr(
        rough_poses._Group,
        "solved",
        lambda scans, own, *more: members.append(own) or solved(scans, own, *more),
    )
    start = rough_poses.start(scans, surfels, wrong)
    # once: scans have nothing against what comes of it, and it is not laid out again
    assert np.concatenate(members).tolist() == list(range(len(truth)))
    assert 0.15 < start.error.step_m < 0.6
    refined = bundle_adjustment.refine(scans, start.world_from_scan).world_from_scan
    assert pose_error(refined, truth).ate_m < 1.5 * pose_error(refined_without.world_from_scan, truth).ate_m


@pytest.mark.parametrize(("points", "left_open"), [(6000, []), (3000, [17])])
def test_what_few_points_leave_open_at_a_jump_is_named(courtyard, points, left_open):
    """With 6,000 points, one scan does not say how far the second jump goes, those on both sides together do: to 5 mm.
    With 3,000 these do not determine it either."""
    _, truth, rough, _ = courtyard
    scans, _, _ = plane_world.recording("courtyard", scans=SCANS, points=points)
    start = rough_poses.start(scans, rough_poses.surfels_of(scans), with_jumps(rough))
    assert start.error.wrong_after.tolist() == [8, 17]
    assert start.error.open_after.tolist() == left_open
    if not left_open:
        off = geometry.inverse(geometry.steps(truth)[17]) @ geometry.steps(start.world_from_scan)[17]
        assert np.linalg.norm(off[:3, 3]) < 0.005


@pytest.mark.parametrize(
    ("few_tell", "many_tell", "still_open"), [(True, True, 0), (False, True, 1), (False, False, None)]
)
def test_a_jump_is_as_many_scans_on_both_sides_have_it_and_counts_as_open(
    few_tell, many_tell, still_open, monkeypatch
):
    """Where few leave it open. Many may be wrong, so nobody is promised that they are not."""
    right = jumped(np.tile(np.eye(4), (2, 1, 1)), 0, [0, 0, 0, 1.0, 0, 0])[1]
    tells = {rough_motions.BESIDE: few_tell, rough_motions.MANY: many_tell}

    def register(scans, second, rough):
        return scan_steps.Step(right, np.eye(6), overlap=0.8, agreeing=1.0, open=0 if tells[scans] else 1)

    monkeypatch.setattr(rough_motions, "beside", lambda patches, poses, k, scans: (scans, scans))
    monkeypatch.setattr(rough_poses.Target, "of", lambda scans: scans)
    monkeypatch.setattr(scan_steps, "register", register)
    chain = rough_poses._Chain(np.tile(np.eye(4), (4, 1, 1)), [None] * 3, np.zeros((3, 6, 6))).closed([], 1)
    if still_open is None:
        assert chain.steps[1] is None
        return
    assert chain.steps[1].open == still_open
    np.testing.assert_allclose(chain.world_from_scan, [np.eye(4), np.eye(4), right, right])


def test_what_many_scans_say_of_a_jump_is_no_witness_of_it(courtyard):
    _, truth, rough, surfels = courtyard
    nothing = np.zeros(0, np.int64)
    asked = []

    def confirmed(patches, poses, after, expected, most=rough_motions.MANY):
        asked.append((after.tolist(), most))
        return nothing

    start = rough_poses.StartPoses(truth, RoughError(0.02, 0.2, np.array([8]), np.array([8, 11]), nothing))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rough_motions, "confirmed", confirmed)
        start.judged(surfels, rough, truth)
    assert asked == [([8], rough_motions.BESIDE), ([11], rough_motions.MANY)]


def test_a_step_left_wrong_is_named(courtyard):
    _, truth, _, surfels = courtyard
    nothing = np.zeros(0, np.int64)
    start = rough_poses.StartPoses(truth, RoughError(0.02, 0.2, nothing, nothing, nothing))
    judged = start.judged(surfels, truth, jumped(truth, 11, [0, 0, 0, 0.7, 0.5, 0]))
    assert judged.left_after.tolist() == [11]


def test_a_motion_that_was_left_open_is_known_where_scans_on_both_sides_confirm_it(courtyard):
    _, truth, rough, surfels = courtyard
    nothing, left_open = np.zeros(0, np.int64), np.array([8, 11, 14])
    start = rough_poses.StartPoses(truth, RoughError(0.02, 0.2, nothing, left_open, nothing))
    assert start.judged(surfels, rough, truth).open_after.tolist() == []
    aside = start.judged(surfels, rough, jumped(truth, 11, [0, 0, 0, 0.7, 0.5, 0]))
    assert aside.open_after.tolist() == [11]


def test_a_motion_that_planes_of_the_map_know_is_not_open_but_for_a_jump(courtyard):
    _, truth, rough, surfels = courtyard
    nothing, aside = np.zeros(0, np.int64), jumped(truth, 11, [0, 0, 0, 0.7, 0.5, 0])
    start = rough_poses.StartPoses(truth, RoughError(0.1, 0.5, nothing, np.array([11]), nothing))
    known, vague = np.full(len(truth) - 1, 0.05), np.full(len(truth) - 1, 0.2)
    assert start.judged(surfels, rough, aside, known).open_after.tolist() == []
    assert start.judged(surfels, rough, aside, vague).open_after.tolist() == [11]
    assert start.judged(surfels, rough, aside, nothing).open_after.tolist() == [11]
    assert start.judged(surfels, rough, aside, known).left_after.tolist() == [11]
    jump = rough_poses.StartPoses(truth, RoughError(0.1, 0.5, np.array([11]), np.array([11]), nothing))
    assert jump.judged(surfels, rough, aside, known).open_after.tolist() == [11]


def test_surfels_of_single_scans_lie_on_each_other_where_the_scans_belong(courtyard):
    _, truth, _, surfels = courtyard
    steps = geometry.inverse(truth[:-1]) @ truth[1:]
    pairs = zip(surfels[:-1], surfels[1:], steps, strict=True)
    overlaps = [scan_steps.overlap(Target.of(first), second, step) for first, second, step in pairs]
    assert min(map(len, surfels)) > 300
    assert min(overlaps) > 0.5


def test_scans_that_see_nothing_follow_the_odometry(courtyard):
    scans, truth, rough, _ = courtyard
    scans = [np.zeros((0, 3), np.float32) if k in (0, 12, 25) else scan for k, scan in enumerate(scans)]
    surfels = rough_poses.surfels_of(scans)
    assert [k for k, each in enumerate(surfels) if each is None] == [0, 12, 25]
    wrong = with_jumps(rough)
    start = rough_poses.start(scans, surfels, wrong)
    assert np.isfinite(start.world_from_scan).all()
    assert pose_error(start.world_from_scan, truth).ate_m < 0.1


def test_a_fast_turn_is_confirmed_and_a_jump_is_not(courtyard):
    """Of one that sensor and poses make together, and of one that only the poses make."""
    scans, truth, _, _ = courtyard
    turn = geometry.exp(np.array([0.02, -0.01, 1.0, 0.0, 0.0, 0.0]))
    turned, poses = scans[:10] + [_moved(turn, scan) for scan in scans[10:]], truth.copy()
    poses[10:] = poses[10:] @ turn
    times = np.arange(SCANS) / 2
    surfels = rough_poses.surfels_of(turned)
    for moved, sure in ((poses, [9]), (jumped(truth, 9, [0, 0, 0.035, 0.9, -0.4, 0.1]), [])):
        trajectory = Trajectory(times, moved)
        assert trajectory_jumps.find(trajectory).after.tolist() == [9]
        expected = trajectory_jumps.expected(trajectory)
        patches = surfels if sure else rough_poses.surfels_of(scans)
        assert rough_motions.confirmed(patches, moved, np.array([9]), expected).tolist() == sure


def test_scans_of_few_points_are_tied_by_those_beside_them_and_jumps_are_not(courtyard, monkeypatch):
    _, truth, rough, _ = courtyard
    surfels = rough_poses.surfels_of(plane_world.recording("courtyard", scans=SCANS, points=1500)[0])
    expected = trajectory_jumps.expected(Trajectory(np.arange(SCANS) / 2, truth))
    inner = np.arange(2, SCANS - 2)
    sure = rough_motions.confirmed(surfels, truth, inner, expected)
    at = np.array([after for after, _ in JUMPS])
    assert len(rough_motions.confirmed(surfels, with_jumps(rough), at, expected)) == 0
    monkeypatch.setattr(rough_motions, "ASKED", rough_motions.ASKED[:1])
    pairs = rough_motions.confirmed(surfels, truth, inner, expected)
    assert len(pairs) <= len(inner) / 2 < 2 * len(inner) / 3 < len(sure)


def _moved(a_from_b, points):
    return geometry.transform_points(geometry.inverse(a_from_b), points).astype(np.float32)


def test_a_motion_that_surfaces_leave_open_is_not_confirmed():
    """A jump along a corridor, which no surface sees."""
    first, second, poses = _corridor()
    for along in (0.0, 1.0):
        jump = poses.copy()
        jump[1, 0, 3] += along
        assert len(rough_motions.confirmed([first, second], jump, np.array([0]), np.eye(4)[None])) == 0


def test_a_motion_that_fits_elsewhere_as_well_is_not_confirmed():
    """Bays of a hall that are all alike: a jump of one bay agrees with all surfaces."""
    world = plane_world.World()
    for center, across in (([0, 0, 0], [0, 6.0, 0]), ([0, -6, 2], [0, 0, 2.0]), ([0, 6, 2], [0, 0, 2.0])):
        world.rectangle(center, [90.0, 0, 0], across)
    for bay in np.arange(-60, 60, 1.0):
        for side in (-4.0, 4.0):
            world.rectangle([bay, side, 2], [0.0, 1.5, 0], [0, 0, 2.0])
    poses = np.stack([plane_world.look([x, 0.0, 1.0], 0.0) for x in (0.2, 0.3)])
    patches = rough_poses.surfels_of(plane_world.scan_all(world, poses, 12000, 0.005, "spinning", 0))
    motion = geometry.inverse(poses[0]) @ poses[1]
    after = np.array([0])
    assert rough_motions.confirmed(patches, poses, after, motion[None]).tolist() == [0]
    jump = poses.copy()
    jump[1, 0, 3] += 1.0
    assert len(rough_motions.confirmed(patches, jump, after, motion[None])) == 0


@pytest.mark.parametrize(("count", "after"), [(40, 11), (50, 14)])
def test_scans_of_a_narrow_sensor_that_turns_do_not_contradict_it_by_another_wall(count, after):
    """They see nothing in common; a wall of the one fits a wall of the other, meters away."""
    poses = plane_world.path("rooms", count)[after : after + 2]
    scans = [
        scan[(scan[:, 0] > 0) & (np.abs(scan[:, 1:]) < scan[:, :1] * [0.42, 0.35]).all(axis=1)]
        for scan in plane_world.scan_all(plane_world.rooms(), poses, 30000, 0.02, "spinning", count)
    ]
    first, second = rough_poses.surfels_of(scans)
    motion = geometry.inverse(poses[0]) @ poses[1]
    step = scan_steps.register(Target.of(first), second, motion)
    assert step.open
    assert np.linalg.norm(step.correction(motion)[3:]) > 1.0  # this is what surfaces fit by
    assert len(rough_motions.contradicted([first, second], poses)) == 0


def test_a_narrow_sensor_that_moves_along_a_wall_is_not_contradicted_by_the_same_wall(tmp_path):
    """More of two scans lies on one another 90 cm from where they belong, in all directions, and neither sees through the
    other; no more of the scans around them does there than where the odometry has them."""
    disturb = Disturbances(clock_drift=0.05)
    sizes = {"frames": 40, "scans": 40, "width": 64, "height": 48, "points_per_scan": 12000}
    simulate("rooms", tmp_path / "rooms", seed=5034, lidar="non_repetitive", disturb=disturb, **sizes)
    dataset = open_dataset(tmp_path / "rooms")
    near = slice(6, 14)
    patches = rough_poses.surfels_of(load_scans(dataset)[near], dataset.sensor_position_scan)
    poses = dataset.scans.world_from_sensor[near]
    motion = geometry.inverse(poses[3]) @ poses[4]
    target, second = Target.of(patches[3]), patches[4]
    step = scan_steps.register(target, second, motion)
    assert not step.open
    assert np.linalg.norm(step.correction(motion)[3:]) > 0.8
    assert step.overlap > scan_steps.overlap(target, second, motion) + 0.1
    assert not scan_steps.contradicts(target, second, motion)
    assert len(rough_motions.contradicted(patches, poses)) == 0


def test_a_jump_at_a_door_is_noticed_by_the_scans_around_it(tmp_path):
    """Two scans on both sides of a door see too little of each other to tell a motion; the four on either side see that
    the odometry's is a meter off."""
    sizes = {"frames": 40, "scans": 40, "width": 64, "height": 48, "difficulty": "medium"}
    simulate("rooms", tmp_path / "rooms", seed=821, disturb=Disturbances(jumps=3), **sizes)
    dataset = open_dataset(tmp_path / "rooms")
    patches = rough_poses.surfels_of(load_scans(dataset), dataset.sensor_position_scan)
    poses = dataset.scans.world_from_sensor
    motion = geometry.inverse(poses[15]) @ poses[16]
    assert not scan_steps.register(Target.of(patches[15]), patches[16], motion).aligned
    assert rough_motions.contradicted(patches, poses).tolist() == [9, 15, 21]


def test_a_single_scan_is_not_contradicted(courtyard):
    _, truth, _, surfels = courtyard
    assert len(rough_motions.contradicted(surfels[:1], truth[:1])) == 0


def _corridor():
    world = plane_world.World()
    for center, second in (([0, -1, 1], [0, 0, 1.5]), ([0, 1, 1], [0, 0, 1.5]), ([0, 0, 0], [0, 1, 0])):
        world.rectangle(center, [60.0, 0, 0], second)
    poses = np.stack(
        [plane_world.look([x, 0.1 * np.sin(3 * x), 1.0], 0.1 * np.sin(2 * x)) for x in (0.0, 0.5)]
    )
    first, second = rough_poses.surfels_of(plane_world.scan_all(world, poses, 6000, 0.01, "spinning", 0))
    return first, second, poses


def test_along_a_corridor_the_odometry_stays():
    """Walls, floor and ceiling do not say how far a scan is along them."""
    first, second, poses = _corridor()
    rough = geometry.inverse(poses[0]) @ poses[1] @ geometry.exp(np.array([0, 0, 0, 0.4, 0.3, 0.1]))
    step = scan_steps.register(Target.of(first), second, rough)
    assert step.open == 1
    off = step.correction(rough)
    along = geometry.inverse(rough)[:3, :3] @ [1.0, 0, 0]
    assert abs(off[3:] @ along) < 0.1
    assert np.linalg.norm(off[3:]) > 0.25
    best = step.beside(rough, np.diag([1e4] * 3 + [1e2] * 3))
    left = geometry.inverse(poses[0]) @ poses[1]
    assert abs((best - rough)[0, 3]) < 0.1
    assert np.abs((best - left)[1:3, 3]).max() < 0.03


def test_errors_of_parts_add_up():
    one = RoughError(0.1, 2.0, np.array([1, 3]), np.array([3]), np.zeros(0, np.int64))
    two = RoughError(0.2, 1.0, np.array([0]), np.zeros(0, np.int64), np.array([0]), by_images=np.array([2]))
    whole = rough_poses.of_all([one.numbered(np.arange(10)), two.numbered(np.arange(8, 20))])
    assert (whole.step_m, whole.step_deg) == (0.2, 2.0)
    assert whole.wrong_after.tolist() == [1, 3, 8]
    assert whole.open_after.tolist() == [3]
    assert whole.left_after.tolist() == [8]
    assert whole.by_images.tolist() == [10]
    assert rough_poses.of_all([]) is None


def test_motions_of_images_are_held_as_usual_where_the_rough_ones_are_off():
    config = LidarConfig()
    rough = geometry.exp(np.outer(np.arange(6.0), [0, 0, 0.1, 1, 0, 0]))
    images = geometry.exp(np.outer(np.arange(6.0), [0, 0, 0.1, 2, 0, 0]))
    none = np.zeros(0, np.int64)
    error = RoughError(0.2, 1.0, none, none, none, by_images=np.array([1, 3]))
    prior = rough_poses.odometry_of(rough, error, images, config)
    np.testing.assert_allclose(prior.previous_from_next[[1, 3], 0, 3], geometry.steps(images)[[1, 3], 0, 3])
    np.testing.assert_allclose(prior.previous_from_next[[0, 2], 0, 3], geometry.steps(rough)[[0, 2], 0, 3])
    np.testing.assert_allclose(prior.information[1, 5, 5], config.prior_translation**-2.0)
    np.testing.assert_allclose(prior.information[0, 5, 5], 0.2**-2.0)

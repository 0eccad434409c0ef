"""The prior: its Jacobians, its prediction, what it estimates, and how it treats frames that are off."""

from dataclasses import replace

import numpy as np
import pytest

from lvba import geometry
from lvba.trajectory import Trajectory
from lvba.visual import camera_motion, trajectory_prior, trajectory_rates, trajectory_sigmas
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior

SIZE = Calibration.layout().size


def handheld(times: np.ndarray) -> np.ndarray:
    """A smooth walk with turns."""
    s = times
    position = np.stack([0.8 * s, 0.3 * np.sin(0.7 * s), 0.05 * np.sin(2.0 * s)], axis=1)
    rotation = np.stack([0.1 * np.sin(1.1 * s), 0.05 * np.cos(0.9 * s), 0.3 * s], axis=1)
    return geometry.from_rotation_translation(
        geometry.exp(np.concatenate([rotation, np.zeros_like(rotation)], axis=1))[:, :3, :3], position
    )


EXTRINSIC = geometry.inverse(geometry.exp(np.array([1.2, -1.1, 1.0, 0.05, -0.1, 0.08])))


def problem(seed: int = 0, offset: float = 0.013, scatter: float = 0.0):
    """A prior whose calibrated mount and clock are wrong by a known amount, and the true state."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.3, 9.7, 30))
    scan_times = np.arange(0, 10.05, 0.1)
    calibrated = EXTRINSIC @ geometry.exp(np.array([0.01, -0.02, 0.015, 0.02, -0.01, 0.03]))
    truth = handheld(times + offset) @ EXTRINSIC
    rough = handheld(times) @ calibrated
    prior = trajectory_prior.build(
        Trajectory(scan_times, handheld(scan_times)), handheld(scan_times), Trajectory(times, rough),
        geometry.inverse(calibrated),
    )  # fmt: skip
    truth = geometry.retract(truth, scatter * rng.normal(size=(30, 6)))
    return prior, VisualState(CameraStates(truth, np.zeros(30)), Calibration(EXTRINSIC, offset))


def moved(state: VisualState, camera: np.ndarray, calibration: np.ndarray) -> VisualState:
    cameras = CameraStates(
        geometry.retract(state.cameras.world_from_camera, camera), state.cameras.log_exposure
    )
    return VisualState(cameras, state.calibration.retract(calibration))


def stacked(prior: Prior, state: VisualState, source: int = 1) -> np.ndarray:
    return trajectory_prior.residuals(prior, prior.sources[source], state)


def test_cameras_on_the_trajectory_have_no_residual():
    prior, state = problem()
    assert np.abs(stacked(prior, state, 0)).max() < 2e-4
    assert np.abs(stacked(prior, state, 1)).max() < 1e-4  # splines; second order in the time offset


@pytest.mark.parametrize("drifting", [False, True])
def test_the_jacobians_agree_with_differences(drifting):
    prior, state = problem()
    prior = replace(prior, drifting=drifting)
    rng = np.random.default_rng(1)
    state = moved(state, 0.1 * rng.normal(size=(30, 6)), 0.1 * rng.normal(size=SIZE))
    by_camera, by_calibration = trajectory_prior.jacobians(prior, prior.sources[1], state)
    h = 1e-6
    for n in range(6):
        step = np.zeros((30, 6))
        step[:, n] = h
        ahead, behind = (
            stacked(prior, moved(state, step, np.zeros(SIZE))),
            stacked(prior, moved(state, -step, np.zeros(SIZE))),
        )
        assert by_camera[:, :, n] == pytest.approx((ahead - behind) / (2 * h), abs=1e-7)
    clock = Calibration.layout()["clock_rate"].start
    assert by_calibration[:, :, clock].any() == drifting
    for n in range(SIZE):
        if n == clock and not drifting:
            continue
        step = np.zeros(SIZE)
        step[n] = h
        still = np.zeros((30, 6))
        ahead, behind = stacked(prior, moved(state, still, step)), stacked(prior, moved(state, still, -step))
        assert by_calibration[:, :, n] == pytest.approx((ahead - behind) / (2 * h), abs=1e-6)


def test_a_clock_that_loses_is_behind_by_more_and_more():
    """Cameras where stamps, an offset and a rate have them are where they are expected."""
    prior, state = problem()
    calibration = replace(state.calibration, clock_rate=0.004)
    moments = calibration.moments(prior.times, prior.epoch)
    assert moments[-1] - prior.times[-1] > calibration.time_offset + 0.015
    assert moments[0] - prior.times[0] < calibration.time_offset - 0.015
    expected = trajectory_prior.predict(prior, prior.sources[1], calibration)
    # to second order in what stamps are off
    wrong = geometry.log(geometry.inverse(handheld(moments) @ EXTRINSIC) @ expected)
    assert np.abs(wrong).max() < 1e-3
    before = trajectory_prior.predict(prior, prior.sources[1], state.calibration)
    assert np.abs(geometry.log(geometry.inverse(before) @ expected)).max() > 0.01


@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-4, 2e-3, 0.7, 3.0])
def test_the_inverse_right_jacobian_agrees_with_differences(angle):
    axis = np.array([0.6, -0.64, 0.48])
    r = angle * axis
    turn = geometry.exp(np.append(r, np.zeros(3)))
    slopes = []
    for n in range(3):
        d = np.zeros(6)
        d[n] = 1e-6
        slopes.append(
            (geometry.log(turn @ geometry.exp(d)) - geometry.log(turn @ geometry.exp(-d)))[:3] / 2e-6
        )
    assert geometry.inverse_right_jacobian(r) == pytest.approx(np.array(slopes).T, abs=1e-6)


def test_the_normal_equations_are_the_derivatives_of_the_cost():
    prior, state = problem(scatter=0.004)
    prior = replace(prior, drifting=True)
    equations = trajectory_prior.linearize(prior, state)
    assert equations.gradient.shape == (30, 7)
    assert equations.border is not None
    rng = np.random.default_rng(2)
    for _ in range(5):
        step, shared = rng.normal(size=(30, 7)), rng.normal(size=SIZE)
        h = 1e-6
        slope = (equations.gradient * step).sum() + equations.border.gradient @ shared
        ahead = trajectory_prior.linearize(prior, moved(state, h * step[:, :6], h * shared)).cost
        behind = trajectory_prior.linearize(prior, moved(state, -h * step[:, :6], -h * shared)).cost
        assert (ahead - behind) / (2 * h) == pytest.approx(slope, rel=1e-5)


def test_one_frame_far_off_pulls_no_harder_than_a_bounded_amount():
    prior, state = problem()
    pulls = []
    for distance in (0.1, 1.0, 5.0):
        step = np.zeros((30, 6))
        step[7, 3] = distance
        pulls.append(
            np.abs(trajectory_prior.linearize(prior, moved(state, step, np.zeros(SIZE))).gradient[7, 3])
        )
    assert pulls[2] == pytest.approx(pulls[1], rel=0.05)
    assert pulls[1] < 3 * pulls[0]


def test_sigmas_are_estimated_from_the_deviations_and_resist_a_few_bad_frames():
    prior, state = problem(scatter=0.0)
    rng = np.random.default_rng(3)
    step = np.concatenate([0.002 * rng.normal(size=(30, 3)), 0.008 * rng.normal(size=(30, 3))], axis=1)
    step[[4, 20]] *= 30
    none = (np.zeros((30, 6)), np.zeros((30, 6)))
    found = trajectory_sigmas.reestimated(prior, moved(state, step, np.zeros(SIZE)), none)
    for source in found.sources:
        assert np.median(source.sigma_rotation) == pytest.approx(0.002, rel=0.4)
        assert np.median(source.sigma_position) == pytest.approx(0.008, rel=0.4)


def test_deviations_that_only_the_prior_decided_do_not_count_as_agreement():
    prior, state = problem()
    rng = np.random.default_rng(4)
    step = np.zeros((30, 6))
    # along two of the camera's axes the images see nothing: there it sits exactly on the prior
    step[:, 3] = 0.01 * rng.normal(size=30)
    undecided = np.zeros((30, 6))
    undecided[:, 4:] = trajectory_prior.sigmas(prior.sources[0])[:, 4:] ** 2
    found = trajectory_sigmas.reestimated(prior, moved(state, step, np.zeros(SIZE)), (undecided, undecided))
    assert found.sources[0].sigma_position[0, 0] == pytest.approx(0.01, rel=0.35)


def test_images_of_which_a_source_tells_nothing_say_nothing_of_it():
    prior, state = problem()
    rng = np.random.default_rng(5)
    step = np.concatenate([0.002 * rng.normal(size=(30, 3)), 0.008 * rng.normal(size=(30, 3))], axis=1)
    silent = np.arange(30) % 5 > 0
    step[silent, 3] += 0.2
    huge = np.where(silent, 1e3, 1.0)[:, None]
    source = replace(
        prior.sources[0],
        sigma_rotation=huge * prior.sources[0].sigma_rotation,
        sigma_position=huge * prior.sources[0].sigma_position,
        silent=np.stack([silent, silent], axis=1),
    )
    none = (np.zeros((30, 6)),)
    for _ in range(3):  # once a level: what is wrong adds up
        prior = trajectory_sigmas.reestimated(
            replace(prior, sources=(source,)), moved(state, step, np.zeros(SIZE)), none
        )
        changed = prior.sources[0]
        np.testing.assert_array_equal(changed.sigma_position[silent], source.sigma_position[silent])
        np.testing.assert_array_equal(changed.sigma_rotation[silent], source.sigma_rotation[silent])
        assert np.median(changed.sigma_position[~silent]) == pytest.approx(0.008, rel=0.5)
        source = changed


def drifted(count: int = 30) -> np.ndarray:
    """A slow deviation of all cameras, 6 cm from end to end, that no single step shows."""
    step = np.zeros((count, 6))
    step[:, 3] = np.linspace(-0.03, 0.03, count)
    return step


@pytest.mark.parametrize(("scan_m", "free"), [(0.001, False), (0.05, True)])
def test_a_slow_deviation_is_allowed_only_as_far_as_the_scans_may_be_off(scan_m, free):
    sure = np.tile(np.diag([1e-8] * 3 + [scan_m**2] * 3), (101, 1, 1))
    scans = Trajectory(np.arange(0, 10.05, 0.1), handheld(np.arange(0, 10.05, 0.1)))
    times = np.linspace(0.5, 9.5, 30)
    cameras = Trajectory(times, handheld(times) @ EXTRINSIC)
    prior = trajectory_prior.build(
        scans, scans.world_from_sensor, cameras, geometry.inverse(EXTRINSIC), scan_covariance=sure
    )
    none = (np.zeros((30, 6)), np.zeros((30, 6)))
    off = moved(
        VisualState(CameraStates(cameras.world_from_sensor, np.zeros(30)), Calibration(EXTRINSIC, 0.0)),
        drifted(),
        np.zeros(SIZE),
    )
    found = trajectory_sigmas.reestimated(prior, off, none)
    for source in found.sources:
        assert source.sigma_position.max() < 0.004
        assert (trajectory_prior.sigmas(source)[:, 3].min() > 0.03) == free
        # what the scans do not explain is no sign that they err together
        assert (source.correlation_inflation[1] > 10) == free
        assert (source.correlation_inflation[1] < 3) == (not free)


def test_a_spline_is_sure_of_itself_at_the_scans():
    times = np.arange(0, 10.05, 0.5)
    at = np.array([2.0, 2.25, 2.5])
    images = Trajectory(at, handheld(at) @ EXTRINSIC)
    source = trajectory_prior.build(
        Trajectory(times, handheld(times)), handheld(times), images, geometry.inverse(EXTRINSIC)
    ).sources[1]
    size = source.sigma_position.max(axis=1)
    assert size[0] == pytest.approx(trajectory_prior.FLOOR_POSITION_M)
    assert size[1] > 1.5 * size[[0, 2]].max()


def test_a_spline_trusts_itself_where_motion_is_smooth_and_not_where_it_is_jerky():
    times = np.arange(0, 10.05, 0.5)
    smooth = handheld(times)
    jerky = smooth.copy()
    jerky[8:13] = jerky[8:13] @ geometry.exp(0.05 * np.random.default_rng(0).normal(size=(5, 6)))
    at = np.array([2.3, 5.3])
    images = Trajectory(at, handheld(at) @ EXTRINSIC)
    build = [
        trajectory_prior.build(Trajectory(times, s), s, images, geometry.inverse(EXTRINSIC))
        for s in (smooth, jerky)
    ]
    calm, shaken = (prior.sources[1] for prior in build)
    sizes = [
        [np.linalg.norm(s, axis=1) for s in (p.sigma_rotation, p.sigma_position)] for p in (calm, shaken)
    ]
    (turn, shift), (turn_shaken, shift_shaken) = sizes
    assert turn_shaken[1] > 5 * turn[1]
    assert shift_shaken[1] > 5 * shift[1]
    assert turn_shaken[0] < 3 * turn[0]


def turning(rng: np.random.Generator):
    """A hand that turns as it likes, at any time: scans every 0.8 s see little of it."""
    rate = rng.uniform(0.5, 3.5, (6, 6))
    phase = rng.uniform(0, 2 * np.pi, (6, 6))
    size = rng.normal(size=(6, 6)) * np.repeat([0.15, 0.08], 3)

    def poses(times: np.ndarray) -> np.ndarray:
        return geometry.exp((size * np.sin(rate * times[:, None, None] + phase)).sum(axis=1))

    return poses


def test_a_spline_knows_that_it_is_worse_near_its_ends():
    """There it is a cubic on one side, and no scan that is left out tells what it misses."""
    scan_times = np.arange(10) * 0.8
    times = scan_times[:-1] + 0.4
    ratio = []
    for seed in range(60):
        poses = turning(np.random.default_rng(seed))
        scans = Trajectory(scan_times, poses(scan_times))
        nothing_of_scans = np.zeros((len(scan_times), 6, 6))
        source = trajectory_prior.build(
            scans, scans.world_from_sensor, Trajectory(times, poses(times)), np.eye(4),
            scan_covariance=nothing_of_scans,
        ).sources[1]  # fmt: skip
        off = geometry.log(geometry.inverse(poses(times)) @ source.world_from_scan)
        ratio.append(off / trajectory_prior.sigmas(source))
    spread = np.sqrt(np.square(ratio).mean(axis=(0, 2)))
    assert spread[[0, -1]].max() < 1.5
    assert spread[1:-1].max() < 1.0
    assert spread.min() > 0.1  # and is not merely careful


def test_beyond_the_scans_the_spline_says_nothing():
    times = np.arange(0, 5.05, 0.5)
    images = Trajectory(np.array([2.0, 7.0]), handheld(np.array([2.0, 7.0])) @ EXTRINSIC)
    prior = trajectory_prior.build(
        Trajectory(times, handheld(times)), handheld(times), images, geometry.inverse(EXTRINSIC)
    )
    assert (prior.sources[1].sigma_position[1] > 100 * prior.sources[1].sigma_position[0]).all()
    assert np.isfinite(prior.sources[0].world_from_scan).all()


@pytest.mark.parametrize(
    "wrong", [{"extrinsic_position_m": 0.0}, {"time_offset_s": 100.0}, {"extrinsic_rotation_deg": -1.0}]
)
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PriorConfig(**wrong)


def test_cameras_tell_how_fast_one_turns_between_scans_that_are_far_apart():
    scan_times, times = np.arange(0.0, 10.0, 0.8), np.arange(0.35, 9.0, 0.8)

    def turning(t):
        turn = np.zeros((len(t), 6))
        turn[:, 2] = 0.5 * np.sin(3.0 * t)
        turn[:, 3] = 0.8 * t
        return geometry.exp(turn)

    truth = turning(times) @ EXTRINSIC
    rates = {}
    for every in (0.8, 0.1):
        scans = scan_times if every == 0.8 else np.arange(0.0, 10.0, 0.1)
        prior = trajectory_prior.build(
            Trajectory(scans, turning(scans)),
            turning(scans),
            Trajectory(times, truth),
            geometry.inverse(EXTRINSIC),
        )
        state = VisualState(CameraStates(truth, np.zeros(len(times))), Calibration(EXTRINSIC))
        rates[every] = [
            each[1][:, 2] for each in ((None, prior.rate_scan), camera_motion.rates(prior, state))
        ]
    expected = 1.5 * np.cos(3.0 * times)
    alone, with_cameras = (np.sqrt(np.mean((each - expected) ** 2)) for each in rates[0.8])
    assert alone > 0.05
    assert with_cameras < 0.5 * alone
    np.testing.assert_array_equal(*rates[0.1])  # near scans tell it themselves
    half = trajectory_prior.take(prior, np.arange(0, len(times), 2))
    assert len(half.times) == len(half) == (len(times) + 1) // 2


def test_an_image_that_rough_motions_tell_nothing_of_follows_the_spline_and_not_without_bound():
    scan_times = np.arange(0, 10.05, 0.5)
    scans = Trajectory(scan_times, handheld(scan_times))
    times = scan_times[:-1] + 0.2
    rough_scans, rough = handheld(scan_times), handheld(times) @ EXTRINSIC
    lost = 9
    rough[lost] = rough[lost] @ geometry.exp(np.array([0, 0, 0.1, 0.4, -0.3, 0]))
    rough_scans[lost + 1 :] = geometry.exp(np.array([0, 0, 0, 0.0, 0.3, 0.4])) @ rough_scans[lost + 1 :]
    rough[lost + 1 :] = geometry.exp(np.array([0, 0, 0, 0.0, 0.3, 0.4])) @ rough[lost + 1 :]
    prior = trajectory_prior.build(
        Trajectory(scan_times, rough_scans), scans.world_from_sensor, Trajectory(times, rough),
        geometry.inverse(EXTRINSIC),
    )  # fmt: skip
    silent = (prior.sources[0].sigma_position > 1).all(axis=1)
    assert silent.nonzero()[0].tolist() == [lost]
    keyframes = np.delete(np.arange(len(times)), [4, lost])
    truth = handheld(times) @ EXTRINSIC
    state = VisualState(CameraStates(truth[keyframes], np.zeros(len(keyframes))), prior.calibration.reference)
    solved = trajectory_prior.take(prior, keyframes)
    for first in (prior, replace(prior, sources=prior.sources[::-1])):
        own = solved if first is prior else replace(solved, sources=solved.sources[::-1])
        poses, added = trajectory_prior.fill(first, own, state, keyframes, times)
        off = np.linalg.norm((poses - truth)[:, :3, 3], axis=1)
        assert off[4] < 0.005
        assert off[lost] < 0.02
        assert np.sqrt(added[lost, 3, 3]) < 0.05
        assert not added[keyframes].any()


def test_a_motion_that_is_not_known_loosens_cameras_by_as_long_as_the_clocks_are_apart():
    """Where scans are a second apart, images 0.1 s late are as far off as the rates by scans are, times 0.1 s."""
    times, scan_times = np.arange(0.55, 9.5, 0.5), np.arange(0, 10.5, 1.0)
    scans, late = Trajectory(scan_times, shaken(scan_times)), 0.1
    images = Trajectory(times, shaken(times) @ EXTRINSIC)
    prior = trajectory_prior.build(
        scans, scans.world_from_sensor, images, geometry.inverse(EXTRINSIC), PriorConfig()
    )
    rates = trajectory_rates.rate_sigmas_of(scans, times)
    assert rates is not None
    before = trajectory_prior.sigmas(prior.sources[0])
    known = trajectory_prior.with_late(prior, Calibration(EXTRINSIC, late))
    loosened = trajectory_prior.sigmas(known.sources[0])
    assert loosened == pytest.approx(np.hypot(before, late * rates))
    actual = VisualState(
        CameraStates(shaken(times + late) @ EXTRINSIC, np.zeros(len(times))), Calibration(EXTRINSIC, late)
    )
    off = trajectory_prior.residuals(prior, prior.sources[0], actual)
    inner = slice(3, -3)  # at the ends, splines extrapolate
    expected = np.sqrt(np.square(late * rates[inner, :3]).mean())
    assert 0.3 < np.sqrt(np.square(off[inner, :3]).mean()) / expected < 2.0
    taken = trajectory_prior.take(known, np.array([2, 5]))
    assert trajectory_prior.sigmas(taken.sources[0]) == pytest.approx(loosened[[2, 5]])
    unknown = replace(prior, scans=None)
    assert trajectory_prior.with_late(unknown, Calibration(EXTRINSIC, late)) is unknown


def shaken(times: np.ndarray) -> np.ndarray:
    """The walk, its sensor turned to and fro by some degrees, nearly faster than a scan each second can show."""
    swing = np.zeros((len(times), 6))
    swing[:, :3] = 0.08 * np.sin(np.outer(times, [1.7, 2.0, 2.3]))
    return handheld(times) @ geometry.exp(swing)

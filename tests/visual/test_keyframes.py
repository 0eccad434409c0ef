import numpy as np
import pytest

from lvba import geometry
from lvba.visual.keyframes import KeyframeConfig, select


def _straight(rate, speed, seconds):
    times = np.arange(0, seconds, 1 / rate)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = speed * times
    return times, poses


@pytest.mark.parametrize("rate", [2, 3, 5])
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_slow_handheld_recordings_keep_every_image(rate, speed):
    times, poses = _straight(rate, speed, 8)
    assert len(select(times, poses, 5.0)) == len(times)


@pytest.mark.parametrize(("rate", "most"), [(10, 5.1), (15, 5.1), (30, 6.0)])
def test_fast_handheld_recordings_are_thinned(rate, most):
    times, poses = _straight(rate, 0.5, 10)
    kept = select(times, poses, 5.0)
    assert 3 <= len(kept) / 10 <= most


def test_a_vehicle_keeps_all():
    times, poses = _straight(10, 10.0, 5)
    assert len(select(times, poses, 15.0)) == len(times)


def test_a_turn_keeps_more():
    times, poses = _straight(30, 0.0, 4)
    turning = poses @ geometry.exp(np.outer(times, [0, 0, np.radians(120), 0, 0, 0]))
    assert len(select(times, turning, 5.0)) > 2 * len(select(times, poses, 5.0))


def test_first_and_last_always():
    times, poses = _straight(30, 0.0, 1.01)
    kept = select(times, poses, 5.0, KeyframeConfig(interval_s=0.8))
    assert kept[0] == 0
    assert kept[-1] == len(times) - 1
    assert (np.diff(kept) > 0).all()
    assert select(times[:1], poses[:1], 5.0).tolist() == [0]


def test_interval_zero_keeps_every_image():
    times, poses = _straight(30, 0.0, 1)
    assert len(select(times, poses, 5.0, KeyframeConfig(interval_s=0))) == len(times)


@pytest.mark.parametrize("bad", [{"interval_s": -1}, {"translation_ratio": 0}, {"rotation_deg": -3}])
def test_keyframe_config_refuses(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        KeyframeConfig(**bad)

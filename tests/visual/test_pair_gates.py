"""The gates that one pair of a scene point and a target must pass, one by one; Li et al., eq. (3)."""

import numpy as np
import pytest
from naive_points import warp_by_plane
from rectangle_world import GATES, INTRINSICS, NOTHING, random_pair

from lvba import geometry
from lvba.kernels import visibility as kernels
from lvba.kernels.homography import plane_homography
from lvba.kernels.scene import PlanePatches


def test_homography_is_ray_plane_intersection():
    rng = np.random.default_rng(0)
    for _ in range(100):
        r, t, position, normal = random_pair(rng)
        u, v = rng.uniform(0, 200), rng.uniform(0, 150)
        h = plane_homography(np.stack([r, t]), 0, 1, position, normal, INTRINSICS)
        x, y, ratio = kernels.warp(h, u, v)
        expected = warp_by_plane(u, v, r, t, position, normal, INTRINSICS)
        assert np.hypot(x - expected[0], y - expected[1]) < 1e-9
        assert ratio == pytest.approx(
            expected[2] / warp_by_plane(u, v, r, r, position, normal, INTRINSICS)[2], abs=1e-12
        )


UNMOVED = np.empty(0)


def _patch(u=100, v=75, position=(0, 0, 4.0), normal=(0, 0, -1.0)):
    """One patch of a wall 4 m ahead, in image 0."""
    return PlanePatches(
        np.array([position]), np.array([normal]), np.zeros(1, np.int32), np.array([[u, v]], np.int32)
    )


def _one_pair(gates=GATES, shift=UNMOVED, **changes):
    """The verdict of a point 4 m ahead on a facing wall, seen from two places, with some things changed."""
    setup = {
        "target": np.zeros(3), "turn": np.zeros(3), "normal": np.array([0, 0, -1.0]), "position": np.array([0, 0, 4.0]),
        "change": lambda image: image,
    } | changes  # fmt: skip
    v, u = np.mgrid[:150, :200]
    image = np.round(120 + 40 * np.sin(0.4 * u) * np.cos(0.3 * v)).astype(np.uint8)[..., None]
    images = np.stack([image, setup["change"](image).astype(np.uint8)])
    poses = np.stack([np.eye(4), geometry.exp(np.concatenate([setup["turn"], [0, 0, 0]]))])
    poses[1, :3, 3] = setup["target"]
    patch = _patch(position=setup["position"], normal=setup["normal"])
    return kernels.judge(images, poses, INTRINSICS, patch, 0, 1, gates, NOTHING, shift)


def test_same_view_passes_and_gain_does_not_matter():
    assert _one_pair() == (kernels.PASSED, pytest.approx(1.0))
    dimmed = _one_pair(change=lambda image: 20 + 0.5 * image)
    assert dimmed[0] == kernels.PASSED
    assert dimmed[1] > 0.999


def test_a_pair_is_judged_where_its_target_pixels_are():
    """The target's picture is moved by three columns and two rows down: only with that shift it is the same."""
    moved = {"change": lambda image: np.roll(image, (2, 3), (0, 1)), "gates": GATES}
    assert _one_pair(**moved)[1] < 0.9
    there = _one_pair(**moved, shift=np.array([3.0, 2.0]))
    assert there == (kernels.PASSED, pytest.approx(1.0))


def test_faint_texture_agrees_with_itself_under_noise_and_noise_with_nothing():
    rng = np.random.default_rng(4)
    faint, noise = 3.0, 2.0
    u = np.mgrid[:150, :200][1]
    texture = faint * np.sqrt(2) * np.sin(0.4 * u)

    def passed(signal):
        images = [np.round(120 + signal + noise * rng.standard_normal(u.shape)) for _ in range(2)]
        stack = np.stack(images).astype(np.uint8)[..., None]
        poses = np.stack([np.eye(4)] * 2)
        rows = []
        for noise_known in (0.0, noise**2):
            gates = GATES._replace(contrast_floor=noise**2 / 4, noise=noise_known)
            rows.append([
                kernels.judge(stack, poses, INTRINSICS, _patch(a, b), 0, 1, gates, NOTHING, UNMOVED)[0] == kernels.PASSED
                for a in range(20, 180, 10) for b in range(20, 130, 10)
            ])  # fmt: skip
        return np.mean(rows, axis=1)

    without, taken_off = passed(texture)
    assert without < 0.2, "the noise alone keeps the correlation below the gate"
    assert taken_off > 0.9
    assert passed(0 * texture)[1] < 0.05


def test_behind_the_camera_is_not_visible():
    turned = np.array([0, np.pi, 0])
    assert _one_pair(turn=turned)[0] == kernels.BEHIND


def test_the_other_side_of_a_wall_is_not_what_is_seen_from_the_next_room():
    pose = geometry.exp(np.array([0, np.pi, 0, 0, 0, 0]))
    pose[:3, 3] = [0, 0, 8.0]
    along, facing = kernels.view_cosines(pose, np.array([0, 0, 4.0]), np.array([0, 0, -1.0]))
    assert along == pytest.approx(1.0)
    assert facing == pytest.approx(-1.0)
    behind = {"target": pose[:3, 3], "turn": np.array([0, np.pi, 0])}
    assert _one_pair(gates=GATES._replace(min_ncc=-2.0), **behind)[0] == kernels.SLANTED


@pytest.mark.parametrize(
    ("verdict", "changes"),
    [
        (kernels.OUTSIDE, {"target": np.array([2.9, 0, 0])}),
        (kernels.SLANTED, {"normal": np.array([1, 0, -0.05]) / np.hypot(1, 0.05)}),
        (kernels.SCALED, {"target": np.array([0, 0, -6.0])}),
        (kernels.SCALED, {"target": np.array([0, 0, 2.6])}),
        (kernels.MASKED, {"change": lambda image: np.where(image > 0, 255, 0)}),
        (kernels.UNLIKE, {"change": lambda image: image[::-1]}),
        (kernels.UNLIKE, {"change": lambda image: np.full_like(image, 120)}),
    ],
)
def test_each_gate_refuses(verdict, changes):
    assert _one_pair(**changes)[0] == verdict


def test_flat_patches_fail_by_the_variance_floor():
    def faint(image):
        return 120 + np.round((image - 120.0) / 20)

    with_floor = _one_pair(change=faint, gates=GATES._replace(contrast_floor=25.0))
    without = _one_pair(change=faint, gates=GATES._replace(contrast_floor=0.0))
    assert without[0] == kernels.PASSED
    assert with_floor[0] == kernels.UNLIKE


def test_color_contrast_alone_does_not_pass():
    # two flat patches of one color: a single mean over channels would correlate perfectly
    rng = np.random.default_rng(0)
    images = np.full((2, 150, 200, 3), [40, 120, 200], np.uint8) + rng.integers(
        0, 3, (2, 150, 200, 3), np.uint8
    )
    gates = GATES._replace(contrast_floor=0.5)
    poses = np.tile(np.eye(4), (2, 1, 1))
    verdict, ncc = kernels.judge(images, poses, INTRINSICS, _patch(), 0, 1, gates, NOTHING, UNMOVED)
    assert verdict == kernels.UNLIKE
    assert abs(ncc) < 0.5

"""What image_poses.txt holds is found out, converted in one place, and written back as it was."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import small_recording
from small_recording import START

from lvba import evaluation, geometry
from lvba.dataset import BODY, CAMERA
from lvba.errors import InputError
from lvba.io import camera_config, image_poses, result_folder, tum
from lvba.io.dataset import open_dataset
from lvba.io.reference import Reference, of_cameras, read_reference
from lvba.trajectory import Trajectory

SMALL_EXTRINSIC = np.array([-0.008, 0.008, 0.003, 0.0255, 0.0, -0.002])
TINY_EXTRINSIC = np.array([2e-3, -1e-3, 1e-3, 2e-3, 1e-3, 2e-3])


def poses_path(root: Path) -> Path:
    return root / "all_image" / "image_poses.txt"


def rewrite(root: Path, kind: str) -> Path:
    """The recording with poses of that kind in its file, nothing else changed."""
    rough = tum.read_trajectory(poses_path(root))
    calibration = camera_config.read_calibration(root)
    extrinsic = calibration.camera_from_lidar @ geometry.inverse(calibration.body_from_lidar)
    tum.write_trajectory(
        poses_path(root),
        Trajectory(rough.times, image_poses.from_camera(rough.world_from_sensor, kind, extrinsic)),
        digits=12,
    )
    return root


def with_extrinsic(root: Path, delta: np.ndarray, noise: float = 0.0) -> Path:
    """A recording of cameras mounted so (camera_from_lidar = exp(delta)), with white noise (rad, and a tenth m)."""
    small_recording.write(root, scans=20, pictures=19)
    extrinsic = geometry.exp(delta)
    text = small_recording.CONFIG.split("extrin_calib")[0]
    rows = {
        "Rcl": extrinsic[:3, :3].ravel(),
        "Pcl": extrinsic[:3, 3],
        "extrinsic_T": np.zeros(3),
        "extrinsic_R": np.eye(3).ravel(),
    }
    text += "extrin_calib:\n" + "".join(f"  {key}: {value.tolist()}\n" for key, value in rows.items())
    (root / "config.yaml").write_text(text)
    times = tum.read_trajectory(poses_path(root)).times
    scale = noise * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    off = geometry.exp(scale * np.random.default_rng(1).normal(size=(len(times), 6)))
    poses = small_recording.walk(times) @ geometry.inverse(extrinsic) @ off
    tum.write_trajectory(poses_path(root), Trajectory(times, poses), digits=12)
    return root


@pytest.mark.parametrize("offset", [None, np.array([456_789.25, 5_123_456.5, 312.0])])
def test_poses_of_the_body_open_as_those_of_its_camera(tmp_path: Path, offset: np.ndarray | None):
    cameras = open_dataset(small_recording.write(tmp_path / "camera", offset=offset))
    bodies = open_dataset(rewrite(small_recording.write(tmp_path / "body", offset=offset), BODY))
    assert (cameras.image_poses, bodies.image_poses) == (CAMERA, BODY)
    assert cameras.warnings == bodies.warnings == ()
    assert "120.0 degrees" in bodies.image_poses_reason
    np.testing.assert_allclose(bodies.images.world_from_sensor, cameras.images.world_from_sensor, atol=2e-9)
    assert cameras.digest != bodies.digest


@pytest.mark.parametrize("kind", [CAMERA, BODY])
@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_a_camera_whose_axes_nearly_are_the_body_s(tmp_path: Path, kind: str, noise: float):
    found = open_dataset(rewrite(with_extrinsic(tmp_path, SMALL_EXTRINSIC, noise), kind))
    assert found.image_poses == kind
    assert found.warnings == ()
    truth = small_recording.walk(found.images.times) @ geometry.inverse(geometry.exp(SMALL_EXTRINSIC))
    np.testing.assert_allclose(found.images.world_from_sensor, truth, atol=1e-8 + 4 * noise)


@pytest.mark.parametrize("kind", [CAMERA, BODY])
def test_an_extrinsic_too_small_to_tell_by_needs_the_key(tmp_path: Path, kind: str):
    root = rewrite(with_extrinsic(tmp_path, TINY_EXTRINSIC, 0.02), kind)
    found = open_dataset(root)
    assert found.image_poses == BODY  # as in FAST-LIVO2's folders
    assert any("image_poses: body" in warning and "config.yaml" in warning for warning in found.warnings)
    for stated in (CAMERA, BODY):
        with_key = (root / "config.yaml").read_text().split("image_poses")[0] + f"image_poses: {stated}\n"
        (root / "config.yaml").write_text(with_key)
        found = open_dataset(root)
        assert (found.image_poses, found.image_poses_reason) == (stated, "config.yaml says so")
        assert found.warnings == ()


def test_the_file_s_own_comment_counts_for_more_than_the_key(tmp_path: Path):
    root = with_extrinsic(tmp_path, TINY_EXTRINSIC, 0.02)
    with open(root / "config.yaml", "a") as file:
        file.write("image_poses: body\n")
    text = poses_path(root).read_text()
    poses_path(root).write_text(f"# {image_poses.comment(CAMERA)}\n{text}")
    assert open_dataset(root).image_poses == CAMERA


def test_a_key_that_the_scan_poses_contradict_is_told_of(tmp_path: Path):
    root = small_recording.write(tmp_path)
    (root / "config.yaml").write_text(small_recording.CONFIG + "image_poses: body\n")
    found = open_dataset(root)
    assert found.image_poses == CAMERA
    assert any("config.yaml says image_poses: body, but" in warning for warning in found.warnings)
    (root / "config.yaml").write_text(small_recording.CONFIG + "image_poses: lidar\n")
    with pytest.raises(InputError, match="image_poses is 'lidar'"):
        open_dataset(root)


def turn_world(root: Path) -> Trajectory:
    """The image poses, after turning and moving the world of all poses: the walk itself hardly turns."""
    shift = geometry.exp(np.array([0.3, -0.5, 1.1, 5, 6, 7]))
    for path in (root / "all_pcd_body" / "lidar_poses.txt", poses_path(root)):
        rough = tum.read_trajectory(path)
        tum.write_trajectory(path, Trajectory(rough.times, shift @ rough.world_from_sensor))
    return tum.read_trajectory(poses_path(root))


def _inverse(poses: np.ndarray) -> np.ndarray:
    return geometry.inverse(poses)


def _w_first(poses: np.ndarray) -> np.ndarray:
    quaternions = np.roll(geometry.quaternion(poses), 1, axis=1)
    return geometry.from_quaternion_translation(quaternions, poses[:, :3, 3])


@pytest.mark.parametrize(
    ("mistake", "kind", "mend"),
    [
        (lambda poses: poses @ geometry.exp(np.array([0, 0, 2.1, 0, 0, 0])), CAMERA, "check that X_camera"),
        (_inverse, CAMERA, "write their inverse"),
        (_inverse, BODY, "write their inverse"),
        (_w_first, CAMERA, "w first"),
        (_w_first, BODY, "w first"),
    ],
)
def test_what_is_far_off_either_way_is_an_error_that_names_the_mistake(tmp_path: Path, mistake, kind, mend):
    root = rewrite(small_recording.write(tmp_path), kind)
    rough = turn_world(root)
    tum.write_trajectory(poses_path(root), Trajectory(rough.times, mistake(rough.world_from_sensor)))
    with pytest.raises(InputError) as caught:
        open_dataset(root)
    assert mend in str(caught.value)
    assert "image_poses.txt" in str(caught.value)
    assert "degrees" in str(caught.value)


def test_an_extrinsic_the_wrong_way_round_is_an_error(tmp_path: Path):
    root = small_recording.write(tmp_path)
    turn_world(root)
    inverted = small_recording.CONFIG.replace(
        "[0, -1, 0, 0, 0, -1, 1, 0, 0]", "[0, 0, 1, -1, 0, 0, 0, -1, 0]"
    )
    (root / "config.yaml").write_text(inverted)
    with pytest.raises(InputError, match="LiDAR from camera: write the inverse"):
        open_dataset(root)


def test_poses_beside_every_scan_cannot_be_compared(tmp_path: Path):
    root = rewrite(small_recording.write(tmp_path), BODY)
    text = (root / "all_pcd_body" / "lidar_poses.txt").read_text().splitlines()
    shifted = [line.replace(line.split()[0], f"{START + 100 + 0.1 * i:.6f}") for i, line in enumerate(text)]
    (root / "all_pcd_body" / "lidar_poses.txt").write_text("\n".join(shifted))
    for i, path in enumerate(small_recording.scan_files(root)):
        path.rename(path.with_name(f"{START + 100 + 0.1 * i:.6f}.pcd"))
    found = open_dataset(root)
    assert found.image_poses == BODY
    assert "no image lies between two scans" in found.image_poses_reason
    assert any("clocks or time zones differ" in warning for warning in found.warnings)
    assert not any("say `image_poses" in warning for warning in found.warnings)  # no statement would mend it
    assert found.findings.apart_s == pytest.approx(99.75, abs=0.4)


@pytest.mark.parametrize("kind", [CAMERA, BODY])
@pytest.mark.parametrize("extrinsic", [None, SMALL_EXTRINSIC, TINY_EXTRINSIC])
def test_a_result_holds_what_the_input_holds_and_comes_back(tmp_path: Path, kind: str, extrinsic):
    root = tmp_path / "in"
    root = small_recording.write(root) if extrinsic is None else with_extrinsic(root, extrinsic, 0.001)
    if extrinsic is TINY_EXTRINSIC:
        with open(root / "config.yaml", "a") as file:
            file.write(f"image_poses: {kind}\n")
    dataset = open_dataset(rewrite(root, kind))
    assert dataset.image_poses == kind
    # cameras further from where they were than the extrinsic is long: the file itself must say what it holds
    moved = dataset.images.world_from_sensor @ geometry.exp(np.array([0.01, 0, 0.01, 0.04, 0.05, 0]))
    result_folder.write_poses(tmp_path, dataset, dataset.scans.world_from_sensor, moved)
    written = tmp_path / "image_poses.txt"
    assert written.read_text().startswith(f"# image_poses: {kind} - ")
    expected = image_poses.from_camera(moved, kind, dataset.camera_from_scan)
    np.testing.assert_allclose(tum.read_trajectory(written).world_from_sensor, expected, atol=2e-9)
    given = evaluation.read_given(dataset, None, written, None)
    np.testing.assert_allclose(given.world_from_camera, moved, atol=2e-9)
    read = result_folder.read_cameras(tmp_path, dataset)
    np.testing.assert_allclose(read.world_from_sensor, moved, atol=2e-9)
    reference = of_cameras(read_reference(tmp_path), dataset)
    np.testing.assert_allclose(reference.images.world_from_sensor, moved, atol=2e-9)


@pytest.mark.parametrize("kind", [CAMERA, BODY])
@pytest.mark.parametrize("scans", [True, False])
def test_a_reference_in_a_world_of_its_own_is_understood_by_its_data(tmp_path: Path, kind: str, scans: bool):
    dataset = open_dataset(small_recording.write(tmp_path, scans=20, pictures=19))
    shift = geometry.exp(np.array([0.3, -0.2, 1.0, 5, 6, 7]))
    truth = shift @ dataset.images.world_from_sensor
    written = image_poses.from_camera(truth, kind, dataset.camera_from_scan)
    carriers = Trajectory(dataset.scans.times, shift @ dataset.scans.world_from_sensor)
    reference = Reference(carriers if scans else None, Trajectory(dataset.images.times, written), None)
    found = of_cameras(reference, dataset)
    np.testing.assert_allclose(found.images.world_from_sensor, truth, atol=1e-9)
    again = of_cameras(found, dataset)
    np.testing.assert_array_equal(again.images.world_from_sensor, found.images.world_from_sensor)


@pytest.mark.parametrize("kind", [CAMERA, BODY])
def test_a_reference_whose_extrinsic_differs_a_little_is_what_the_recording_holds(tmp_path: Path, kind: str):
    """Of a Kinect: the kinds are 0.8 degrees and 5 mm apart, the true extrinsic 0.3 degrees and 5 mm off config.yaml."""
    delta = np.array([0.008, -0.01, 0.005, 0.003, 0.004, 0.0])
    dataset = open_dataset(with_extrinsic(tmp_path, delta, noise=0.017))
    dataset = dataclasses.replace(dataset, image_poses=kind)
    off = geometry.exp(np.array([0.003, 0.004, 0.0, 0.003, 0.004, 0.0]))
    truth = dataset.images.world_from_sensor @ off
    written = image_poses.from_camera(truth, kind, dataset.camera_from_scan)
    reference = Reference(dataset.scans, Trajectory(dataset.images.times, written), None)
    found = of_cameras(reference, dataset)
    np.testing.assert_allclose(found.images.world_from_sensor, truth, atol=1e-9)


def test_a_reference_whose_images_do_not_belong_to_its_scans_is_refused(tmp_path: Path):
    dataset = open_dataset(small_recording.write(tmp_path))
    turned = dataset.images.world_from_sensor @ geometry.exp(np.array([0, 0, 2.1, 0, 0, 0]))
    reference = Reference(dataset.scans, Trajectory(dataset.images.times, turned), None)
    with pytest.raises(InputError, match=r"image_poses\.txt of the reference"):
        of_cameras(reference, dataset)
    tum.write_trajectory(tmp_path / "turned.txt", Trajectory(dataset.images.times, turned))
    with pytest.raises(InputError, match=r"turned\.txt"):
        evaluation.read_given(dataset, None, tmp_path / "turned.txt", None)


def test_results_of_versions_that_said_nothing_hold_the_camera_s(tmp_path: Path):
    dataset = open_dataset(small_recording.write(tmp_path / "in"))
    tum.write_trajectory(tmp_path / "image_poses.txt", dataset.images)
    bodies = dataclasses.replace(dataset, image_poses=BODY)
    read = result_folder.read_cameras(tmp_path, bodies)
    np.testing.assert_allclose(read.world_from_sensor, dataset.images.world_from_sensor, atol=2e-9)


EXTRINSIC = small_recording.camera_from_body()


def by_hand(times: np.ndarray) -> np.ndarray:
    """World from body, (N, 4, 4), of a sensor swung by half a radian while it is carried round, a turn in 60 s."""
    zero = np.zeros_like(times)
    turned = geometry.exp(np.stack([zero, zero, 0.1 * times, zero, zero, zero], axis=1))
    swung = geometry.exp(
        np.stack([0.5 * np.sin(1.3 * times), 0.5 * np.sin(1.7 * times), zero, zero, zero, zero], axis=1)
    )
    poses = turned @ swung
    poses[:, :3, 3] = 5 * np.stack([np.sin(0.1 * times), np.cos(0.1 * times), zero], axis=1)
    return poses


def decided(scan_times, image_times, kind, extrinsic=EXTRINSIC, mistake=lambda poses: poses, statement=None):
    """What is decided of right poses of a kind, or of poses with a mistake."""
    images = image_poses.from_camera(by_hand(image_times) @ geometry.inverse(extrinsic), kind, extrinsic)
    return image_poses.decide(
        Trajectory(image_times, mistake(images)), Trajectory(scan_times, by_hand(scan_times)),
        extrinsic, statement or image_poses.Statement(), "poses.txt",
    )  # fmt: skip


FAR_APART = np.arange(0.0, 65.0, 16.0)
IN_A_PAUSE = np.concatenate([np.arange(0.0, 4.0, 0.2), np.arange(60.0, 64.0, 0.2)])
EVERY_HALF_SECOND = np.arange(0.37, 63.0, 0.5)


@pytest.mark.parametrize("kind", [CAMERA, BODY])
@pytest.mark.parametrize("scan_times", [FAR_APART, IN_A_PAUSE], ids=["far apart", "one pause"])
def test_right_poses_between_scans_far_apart_are_not_refused(scan_times, kind):
    """Before: `image poses and scan poses disagree by 34.2 degrees`."""
    found = decided(scan_times, EVERY_HALF_SECOND, kind)
    assert (found.kind, found.warnings) == (kind, ())


@pytest.mark.parametrize("kind", [CAMERA, BODY])
def test_between_scans_far_apart_a_small_extrinsic_is_not_decided_by_chance(kind):
    small = geometry.exp(np.array([0.1, -0.1, 0.05, 0.1, 0.05, 0.1]))
    found = decided(FAR_APART, EVERY_HALF_SECOND, kind, small)
    assert found.kind == BODY
    assert any("say `image_poses: body`" in warning for warning in found.warnings)
    stated = decided(FAR_APART, EVERY_HALF_SECOND, kind, small, statement=image_poses.Statement(kind, "it"))
    assert (stated.kind, stated.warnings) == (kind, ())
    assert decided(IN_A_PAUSE, EVERY_HALF_SECOND, kind, small).kind == kind, "images before and after tell"


def test_images_taken_with_scans_far_apart_show_mistakes():
    assert decided(FAR_APART, FAR_APART + 0.02, CAMERA).kind == CAMERA
    with pytest.raises(InputError, match="w first"):
        decided(FAR_APART, FAR_APART + 0.02, CAMERA, mistake=_w_first)

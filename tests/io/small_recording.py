"""A tiny valid recording on disk, to be opened as it is or damaged first."""

from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.io import images, pcd, tum
from lvba.trajectory import Trajectory

START = 1_630_577_758.0
WIDTH, HEIGHT = 32, 24

RCL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
PCL = np.array([0.02, 0.10, -0.03])
EXTRINSIC_T = np.array([0.04, 0.02, -0.03])

CONFIG = """\
cam_model:
  cam_width: 32
  cam_height: 24
  scale: 1.0
  cam_fx: 30.5
  cam_fy: 31.0
  cam_cx: 15.5
  cam_cy: 11.5
  cam_d0: -0.1
  cam_d1: 0.02
  cam_d2: 0.001
  cam_d3: -0.002
extrin_calib:
  extrinsic_T: [0.04, 0.02, -0.03]
  extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
  Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]
  Pcl: [0.02, 0.10, -0.03]
"""


def camera_from_body() -> np.ndarray:
    return geometry.from_rotation_translation(RCL, PCL) @ geometry.inverse(
        geometry.from_rotation_translation(np.eye(3), EXTRINSIC_T)
    )


def walk(times: np.ndarray, offset: np.ndarray | None = None) -> np.ndarray:
    """World from body, (N, 4, 4), on a gentle curve."""
    t = times - START
    delta = np.stack([0.02 * t, 0.03 * np.sin(t), 0.1 * t, 0.5 * t, 0.2 * np.sin(t), 0.05 * t], axis=1)
    poses = geometry.exp(delta)
    if offset is not None:
        poses[:, :3, 3] += offset
    return poses


def write(
    root: Path,
    scans: int = 6,
    pictures: int = 5,
    *,
    offset: np.ndarray | None = None,
    suffix: str = ".png",
    encoding: str = "binary",
    poses_inside: bool = True,
) -> Path:
    """Writes the recording and gives its folder back; images are 50 ms later than scans."""
    rng = np.random.default_rng(0)
    scan_folder, image_folder = root / "all_pcd_body", root / "all_image"
    scan_folder.mkdir(parents=True)
    scan_times = START + 0.1 * np.arange(scans)
    for time in scan_times:
        points = rng.uniform(-5, 5, (50, 3)).astype(np.float32)
        pcd.write_pcd(scan_folder / f"{time:.6f}.pcd", points, rng.uniform(0, 255, 50), encoding=encoding)
    place = scan_folder if poses_inside else root
    tum.write_trajectory(place / "lidar_poses.txt", Trajectory(scan_times, walk(scan_times, offset)))
    if not pictures:
        return root
    image_folder.mkdir()
    image_times = START + 0.05 + 0.1 * np.arange(pictures)
    for time in image_times:
        rgb = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        images.write_image(image_folder / f"{time:.6f}{suffix}", rgb)
    poses = walk(image_times, offset) @ geometry.inverse(camera_from_body())
    place = image_folder if poses_inside else root
    tum.write_trajectory(place / "image_poses.txt", Trajectory(image_times, poses))
    (root / "config.yaml").write_text(CONFIG)
    return root


def scan_files(root: Path) -> list[Path]:
    return sorted((root / "all_pcd_body").glob("*.pcd"))


def image_files(root: Path) -> list[Path]:
    return sorted((root / "all_image").glob("*.[pj][np]g"))

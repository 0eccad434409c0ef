"""How far relative poses of neighboring images are from what matched features and depths say: a witness of its own.

    python benchmarks/neighbors.py DATASET POSES [POSES ...]
    python benchmarks/neighbors.py DATASET POSES [POSES ...] --apart 6

POSES: folders with image_poses.txt: results, a recording's `reference`, or DATASET itself for its input poses.
`--apart N`: of pairs that are N or more images apart, instead, 3,000 at random: whether a place has one place.
For each pair of successive images: SIFT features (Lowe 2004) matched both ways, depths of the first image's features
from the scan nearest in time (by the calibrated extrinsic), the pose of the second image by PnP with RANSAC (OpenCV).
It shares nothing with the bundle adjustments, and nothing with the reference. Prints one JSON object: for each folder
the median and root mean square of the differences, degrees and mm, over the pairs that could be measured.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from lvba import geometry
from lvba.dataset import Dataset
from lvba.io.dataset import load_image, load_scan, open_dataset
from lvba.io.reference import of_cameras, read_reference
from lvba.lens import Lens
from lvba.trajectory import nearest_in_time

_MOST_APART = 3000
"""Pairs of images far apart that are tried."""
_RATIO = 0.75
"""The best match must be this much nearer than the second best."""
_LEAST_INLIERS = 40
_REPROJECTION_PX = 2.0
_DEPTH_RADIUS_PX, _DEPTH_SPREAD = 2, 0.02
"""Depths are means over so many pixels around a feature, where they differ by less than this part."""


def features(dataset: Dataset, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and descriptors (N, 128) of an image."""
    gray = cv2.cvtColor(load_image(dataset, index), cv2.COLOR_RGB2GRAY)
    points, descriptors = cv2.SIFT_create(4000).detectAndCompute(gray, None)
    return np.array([point.pt for point in points]).reshape(-1, 2), descriptors


def normalized(dataset: Dataset, pixels: np.ndarray) -> np.ndarray:
    """(N, 2) coordinates in front of the lens."""
    camera = dataset.camera
    if camera.lens is Lens.RADIAL_TANGENTIAL:
        undistort = cv2.undistortPoints
        coefficients = np.array(camera.distortion)
    else:
        undistort, coefficients = cv2.fisheye.undistortPoints, np.array(camera.distortion[:4])
    return np.asarray(undistort(pixels.reshape(-1, 1, 2).astype(float), camera.matrix, coefficients)).reshape(
        -1, 2
    )


def depths(dataset: Dataset, index: int, directions: np.ndarray) -> np.ndarray:
    """(N,) m along the camera's axis, in directions (N, 2) as `normalized`; NaN where the scan has no one depth."""
    scan = int(nearest_in_time(dataset.scans.times, dataset.images.times[index : index + 1])[0])
    points = geometry.transform_points(
        dataset.camera_from_scan, load_scan(dataset, scan).points.astype(float)
    )
    points = points[points[:, 2] > 0.1]
    focal = dataset.camera.fx
    where = np.rint(focal * points[:, :2] / points[:, 2:]).astype(int)
    wanted = np.rint(focal * directions).astype(int)
    reach = int(np.abs(wanted).max()) + _DEPTH_RADIUS_PX + 1
    inside = (np.abs(where) < reach).all(1)
    near = np.full((2 * reach + 1, 2 * reach + 1), np.inf)
    np.minimum.at(near, tuple((where[inside] + reach).T), points[inside, 2])
    near[~np.isfinite(near)] = np.nan
    steps = range(-_DEPTH_RADIUS_PX, _DEPTH_RADIUS_PX + 1)
    around = np.stack(
        [near[wanted[:, 0] + reach + a, wanted[:, 1] + reach + b] for a in steps for b in steps]
    )
    known = np.isfinite(around).sum(0)
    filled = np.where(np.isfinite(around), around, 0.0)
    mean = filled.sum(0) / np.maximum(known, 1)
    spread = np.where(np.isfinite(around), np.abs(around - mean), 0.0).max(0)
    return np.where((known >= 3) & (spread < _DEPTH_SPREAD * mean), mean, np.nan)


def measured(dataset: Dataset, index: int, one: tuple, other: tuple) -> np.ndarray | None:
    """other_from_one (4, 4) of the cameras of two images, `index` being the one; None: too few features agree."""
    if one[1] is None or other[1] is None:
        return None
    matcher = cv2.BFMatcher()
    forth, back = (matcher.knnMatch(a, b, k=2) for a, b in ((one[1], other[1]), (other[1], one[1])))
    best = {
        m[0].queryIdx: m[0].trainIdx for m in back if len(m) == 2 and m[0].distance < _RATIO * m[1].distance
    }
    pairs = [
        (m[0].queryIdx, m[0].trainIdx)
        for m in forth
        if len(m) == 2 and m[0].distance < _RATIO * m[1].distance and best.get(m[0].trainIdx) == m[0].queryIdx
    ]
    if len(pairs) < _LEAST_INLIERS:
        return None
    first, second = np.array(pairs).T
    here, there = normalized(dataset, one[0][first]), normalized(dataset, other[0][second])
    depth = depths(dataset, index, here)
    known = np.isfinite(depth)
    if known.sum() < _LEAST_INLIERS:
        return None
    points = np.column_stack([here, np.ones(len(here))])[known] * depth[known, None]
    solved, turn, shift, inliers = cv2.solvePnPRansac(
        points, there[known], np.eye(3), None, reprojectionError=_REPROJECTION_PX / dataset.camera.fx,
        iterationsCount=2000, confidence=0.9999,
    )  # fmt: skip
    if not solved or inliers is None or len(inliers) < _LEAST_INLIERS:
        return None
    agreed = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[agreed], there[known][agreed], np.eye(3), None, turn, shift)
    return geometry.from_rotation_translation(cv2.Rodrigues(turn)[0], shift.ravel())


def differences(world_from_camera: np.ndarray, pairs: dict[tuple[int, int], np.ndarray]) -> dict[str, float]:
    """Of relative poses from those measured, by the numbers of the images of each pair."""
    first, second = np.array(sorted(pairs)).T
    relative = geometry.inverse(world_from_camera[second]) @ world_from_camera[first]
    off = geometry.inverse(np.stack([pairs[key] for key in sorted(pairs)])) @ relative
    degrees, mm = geometry.rotation_angle_deg(off), 1e3 * np.linalg.norm(off[:, :3, 3], axis=1)
    return {
        "deg_median": float(np.median(degrees)),
        "deg_rms": float(np.sqrt(np.mean(degrees**2))),
        "mm_median": float(np.median(mm)),
        "mm_rms": float(np.sqrt(np.mean(mm**2))),
        "mm_p90": float(np.percentile(mm, 90)),
    }


def tried(images: int, apart: int) -> list[tuple[int, int]]:
    """Successive images, or those of a random choice that are so many apart."""
    if not apart:
        return [(index, index + 1) for index in range(images - 1)]
    every = [(i, j) for i in range(images) for j in range(i + apart, images)]
    chosen = np.random.default_rng(0).permutation(len(every))[:_MOST_APART]
    return [every[index] for index in np.sort(chosen)]


def cameras(dataset: Dataset, folder: Path) -> np.ndarray:
    """world_from_camera (I, 4, 4) of a folder of poses."""
    if folder.resolve() == Path(dataset.root).resolve():
        return dataset.images.world_from_sensor
    read = of_cameras(read_reference(folder), dataset).images
    assert read is not None, f"{folder} has no image_poses.txt"
    assert len(read) == len(dataset.images), f"{folder} has other images"
    return read.world_from_sensor


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("poses", type=Path, nargs="+")
    parser.add_argument(
        "--apart", type=int, default=0, help="images from one to the other of a pair, at least"
    )
    given = parser.parse_args()
    cv2.setRNGSeed(0)
    dataset = open_dataset(given.dataset)
    of_image = [features(dataset, index) for index in range(len(dataset.image_paths))]
    chosen, pairs = tried(len(of_image), given.apart), {}
    for one, other in chosen:
        if (relative := measured(dataset, one, of_image[one], of_image[other])) is not None:
            pairs[one, other] = relative
    judged = {str(each): differences(cameras(dataset, each), pairs) for each in given.poses}
    print(json.dumps({"pairs": len(pairs), "of": len(chosen), **judged}, indent=1))


if __name__ == "__main__":
    main()

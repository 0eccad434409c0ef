"""How far off scans, cameras and map points are expected to be, from the covariances of the result.

All of it is error within the result, after one rigid alignment with the truth: where the whole stands in the world, and
how it is turned there, is as the input has it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lvba.arrays import PoseBlocks, Poses
from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.products.map_error import Tally, counted
from lvba.products.map_file import PointMap
from lvba.steps import camera_agreement, uncertainty
from lvba.steps.open_motions import OpenMotions
from lvba.steps.outcomes import Accepted, FusionStage, LidarStage, VisualStage
from lvba.steps.uncertainty import Expected
from lvba.visual import image_groups
from lvba.visual.result import VisualResult


def of_result(lidar: LidarStage, fused: FusionStage, visual: VisualStage, accepted: Accepted) -> Expected:
    """What is known of the poses that are the result.

    Nothing is known of poses that are the input's, but of cameras that refined ones confirm. Nor of cameras where the
    scans are the input's: their covariances count from the map that these make.
    """
    scans = scan_covariance(lidar, fused, accepted)
    cameras, result = None, visual.result
    if scans is not None and result is not None and (accepted.cameras.accepted or accepted.cameras.confirmed):
        cameras = where_known(_of_cameras(result, by_images(fused, accepted)))
        if not accepted.cameras.accepted:
            cameras = camera_agreement.expected_squares(
                result.world_from_camera, cameras, accepted.world_from_camera
            )
    return Expected(None if scans is None else where_known(scans), cameras)


def scan_covariance(lidar: LidarStage, fused: FusionStage, accepted: Accepted) -> np.ndarray | None:
    """(S, 6, 6) of the scan poses that are the result, with errors that planes close to each other share; None where
    these are the input's."""
    if lidar.result is None or not accepted.scans.accepted:
        return None
    if fused.result is not None and accepted.fusion.accepted:
        return lidar.result.shared_factor * fused.result.covariance
    return of_lidar(lidar.result)


def of_lidar(result: LidarResult) -> np.ndarray:
    """(S, 6, 6) of refined scans, with errors that planes close to each other share."""
    return result.shared_factor * result.whole_covariance.marginal


def _of_cameras(result: VisualResult, open_motions: OpenMotions | None) -> np.ndarray:
    """(I, 6, 6) of the cameras; along these motions as images know them, of the one group that nearly all are of."""
    if open_motions is None:
        return result.covariance
    tied = (result.group < 0) | image_groups.in_largest(result.group)
    along = open_motions.at(result.world_from_camera)
    return along.known_by(result.covariance, result.local_covariance, tied)


def by_images(fused: FusionStage, accepted: Accepted) -> OpenMotions | None:
    """The motions that planes leave open for all scans, where these are as images of one group have them; else None."""
    if fused.result is None or not (accepted.fusion.accepted and fused.result.open_by_images):
        return None
    return fused.result.open_motions


def where_known(covariance: np.ndarray) -> np.ndarray:
    """The same with NaN where a frame has none (not finite, or all zero). covariance: (N, 6, 6) float64"""
    known = uncertainty.is_known(covariance)
    return np.where(known[:, None, None], covariance, np.nan)


def collect(
    expected: Expected,
    pieces: Sequence[Callable[[], PointMap]],
    world_from_scan: Poses,
    range_noise_m: float | None = None,
    of_ranges_m: float = 0.0,
    along_open_m: float = 0.0,
    open_by: str = "odometry",
    open_by_images_m: float | None = None,
) -> dict[str, Any]:
    """The `expected_error` part of report.json.

    pieces: read the map, one piece at a time; world_from_scan: (S, 4, 4), that it was made with
    range_noise_m: how far single points are off their surface
    of_ranges_m: how far scans may be off by errors of ranges that stay in their points
    along_open_m: how far they may be off along motions that planes leave open for all of them
    open_by: images or odometry, by which that is known; open_by_images_m: the same if images are right about these
        motions, where they are not of one group; None: they were not asked
    """
    tally = Tally()
    for piece in pieces:
        tally.add(counted(piece(), world_from_scan))
    return {
        "scans": of_poses(expected.scans),
        "cameras": of_poses(expected.cameras),
        "map": tally.facts(),
        "of_ranges_m": of_ranges_m if expected.scans is not None else None,
        "along_open_m": along_open_m if expected.scans is not None else None,
        "open_by": open_by if expected.scans is not None and along_open_m else None,
        "open_by_images_m": open_by_images_m if expected.scans is not None else None,
        "note": _note(range_noise_m),
    }


def along_open(
    covariance: PoseBlocks | None, world_from_scan: Poses, directions: Sequence[DegenerateDirection]
) -> float:
    """How far scans are expected to be off along degenerate directions of all of them, m, root mean square.

    covariance: (S, 6, 6), of scans; NaN where nothing is known; world_from_scan: (S, 4, 4)
    """
    open_motions = OpenMotions.of(directions)
    if covariance is None or open_motions is None:
        return 0.0
    known = np.isfinite(covariance[:, 0, 0])
    return open_motions.at(world_from_scan).shift_m(covariance, known)


def of_poses(covariance: PoseBlocks | None) -> dict[str, Any] | None:
    """Expected errors of poses with covariances (N, 6, 6); None where nothing is known.

    position_m, rotation_deg: root mean square over the frames; position_p95_m: 95 of 100 frames are expected to be off by
    less; per_frame_m: by frame, NaN where not known
    """
    if covariance is None or not np.isfinite(covariance[:, 0, 0]).any():
        return None
    rotation, position = (np.trace(covariance[:, s, s], axis1=1, axis2=2) for s in (slice(3), slice(3, 6)))
    known = np.isfinite(position)
    return {
        "position_m": float(np.sqrt(position[known].mean())),
        "position_p95_m": float(np.sqrt(np.quantile(position[known], 0.95))),
        "rotation_deg": float(np.degrees(np.sqrt(rotation[known].mean()))),
        "per_frame_m": np.sqrt(position),
    }


def _note(range_noise_m: float | None) -> str:
    scatter = f" (here {1000 * range_noise_m:.1f} mm)" if range_noise_m is not None else ""
    return (
        "Root mean squares from the covariances of the refined poses, after one rigid alignment: errors within the map, "
        "not of its place in the world. They do not contain what all frames have in common (a wrong calibration, lens or "
        f"clock), nor the noise of a single point about its surface{scatter}."
    )

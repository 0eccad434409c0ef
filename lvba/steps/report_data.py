"""The facts of a run, as plain data: report.json without what only the runner knows (seconds, memory, versions)."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lvba import geometry
from lvba.blocks.decoded_scans import MovingPoints
from lvba.dataset import Dataset
from lvba.io.reference import Reference
from lvba.lidar import range_errors
from lvba.lidar.range_errors import RangeErrors
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan_errors import ScanErrors
from lvba.lidar.scan_motion import MotionLeft
from lvba.products import judging_size
from lvba.products.evaluate import Scores
from lvba.products.map_file import PointMap
from lvba.products.reference import matched
from lvba.steps import (
    expected_error,
    fused_cameras,
    odometry_data,
    plane_thickness,
    reference_data,
    verdict,
    verdict_data,
)
from lvba.steps.acceptance import ROUGH
from lvba.steps.outcomes import Accepted, FusionStage, LidarStage, ScanPoses, VisualStage
from lvba.steps.plane_thickness import PlaneChange
from lvba.steps.uncertainty import Expected
from lvba.visual import exposures_between, fixed_calibration, self_calibration
from lvba.visual.radiometry import Radiometry
from lvba.visual.response import GREY_VALUES
from lvba.visual.result import VisualResult

_VISIBLE = 0.005
"""Standard deviation of a log exposure below which nobody sees what is off: a grey value of 200 by 1."""


def collect(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    visual: VisualStage,
    fused: FusionStage,
    scores: Mapping[str, Scores],
    accepted: Accepted,
    expected: Expected,
    pieces: Sequence[Callable[[], PointMap]],
    planes: Sequence[PlaneChange],
    reference: Reference | None,
    merge: Mapping[str, Any] | None = None,
    errors: ScanErrors | None = None,
    moving: Sequence[MovingPoints] = (),
) -> dict[str, Any]:
    """Everything the report says about the dataset, the stages, the evaluation and the reference, and the verdict on it.

    pieces: read the map, one piece at a time; planes: of all regions of space; merge: facts of a run in parts
    errors: of the scans; None: not measured; moving: of all parts, taken out of the map
    """
    visual = fused_cameras.in_use(visual, accepted)
    facts: dict[str, Any] = {
        "dataset": of_dataset(dataset),
        "lidar": of_lidar(lidar, scans, accepted) | of_scan_errors(errors) | of_moving_points(moving),
        "visual": of_visual(dataset, visual, accepted),
        "fusion": of_fusion(fused, accepted),
        "trajectory": of_trajectories(dataset, accepted),
        "exposure": of_exposure(dataset, accepted, visual, reference),
        "evaluation": of_evaluation(dataset, scans, scores, accepted.state),
    }
    if reference is not None:
        facts["reference"] = reference_data.collect(
            dataset, lidar, scans, visual, fused, accepted, expected, reference
        )
    facts["warnings"] = _warnings(dataset, lidar, visual, accepted) + warnings_of_errors(
        errors, dataset.deskewed_by
    )
    noise = lidar.result.history[-1].sigma if lidar.result is not None and lidar.result.history else None
    of_ranges_m = 0.0 if errors is None or errors.ranges is None else errors.ranges.poses_off[1]
    open_ = () if lidar.result is None else lidar.result.degenerate_directions
    along_open_m = expected_error.along_open(expected.scans, accepted.world_from_scan, open_)
    open_by = "odometry" if expected_error.by_images(fused, accepted) is None else "images"
    if_images_are_right = None
    if open_by == "odometry" and along_open_m and accepted.fusion.accepted and fused.result is not None:
        if_images_are_right = fused.result.slide_sigma_m
    facts["expected_error"] = expected_error.collect(
        expected, pieces, accepted.world_from_scan,
        range_noise_m=noise, of_ranges_m=of_ranges_m, along_open_m=along_open_m,
        open_by=open_by, open_by_images_m=if_images_are_right,
    )  # fmt: skip
    facts["planes"] = plane_thickness.facts(planes)
    facts["odometry"] = odometry_data.of_odometry(dataset, accepted, lidar, visual)
    if merge is not None:
        facts["merge"] = merge
    return verdict_data.add(plain(facts))


def of_dataset(dataset: Dataset) -> dict[str, Any]:
    """Counts, times and camera of the input."""
    times = np.concatenate([dataset.scans.times, dataset.images.times])
    positions = dataset.scans.world_from_sensor[:, :3, 3]
    speaks_against = {name: value for name, value in _fields(dataset.findings, ()).items() if value}
    return {
        "digest": dataset.digest,
        "scans": len(dataset.scan_paths),
        "images": len(dataset.image_paths),
        "duration_s": float(times.max() - times.min()),
        "path_length_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "camera": dataclasses.asdict(dataset.camera) if dataset.image_paths else None,
        "image_poses": {"of": dataset.image_poses, "reason": dataset.image_poses_reason}
        if dataset.image_paths
        else None,
        "origin": dataset.origin,
        "warnings": list(dataset.warnings),
        **({"findings": speaks_against} if speaks_against else {}),
    }


def of_lidar(lidar: LidarStage, scans: ScanPoses, accepted: Accepted) -> dict[str, Any]:
    """What the LiDAR stage did."""
    facts: dict[str, Any] = {
        "accepted": accepted.scans.accepted,
        "reason": accepted.scans.reason,
        "cause": accepted.scans.cause,
        "judged": accepted.scans.figures,
        "entropy_rough": scans.entropy_rough,
        "entropy_refined": scans.entropy_refined,
    }
    if lidar.result is not None:
        facts |= _fields(
            lidar.result,
            but=(
                *("world_from_scan", "planes", "plane_points", "covariance", "conditional_covariance"),
                *("map_covariance", "step_covariance", "own_covariance", "inertial", "mixed"),
            ),
        )
        if lidar.result.inertial is not None:
            facts["imu"] = lidar.result.inertial.facts()
        facts["planes"] = len(lidar.result.planes)
    return facts


def of_scan_errors(errors: ScanErrors | None) -> dict[str, Any]:
    """Errors of the range sensor; how much of the motion was left in scans, and by what their points were moved."""
    if errors is None:
        return {}
    facts: dict[str, Any] = {} if errors.motion is None else {"motion_left": errors.motion.facts()}
    return facts if errors.ranges is None else facts | {"range_errors": errors.ranges.facts()}


def of_moving_points(moving: Sequence[MovingPoints]) -> dict[str, Any]:
    """How many points move, and what fraction of all they are."""
    count = sum(len(each.numbers) for each in moving)
    fraction = count / max(sum(each.count for each in moving), 1)
    return {"moving_points": {"count": count, "fraction": fraction}}


def warnings_of_errors(errors: ScanErrors | None, deskewed_by: tuple[str, ...] = ()) -> list[str]:
    """That points were moved, or why not. deskewed_by: `Dataset.deskewed_by`: no warning that scans were so deskewed"""
    if errors is None:
        return []
    said = errors.motion is not None and errors.motion.by_rough == deskewed_by != ()
    return warnings_of_ranges(errors.ranges) + ([] if said else warnings_of_motion(errors.motion))


_NOT_CORRECTED = {
    range_errors.DIRECTION: ": points were not corrected. Calibrate the sensor",
    range_errors.DEPTH: ". The points were not corrected; the expected errors of map and cameras include this",
}


def warnings_of_ranges(ranges: RangeErrors | None) -> list[str]:
    """What the sensor's calibration should have."""
    if ranges is None:
        return []
    if ranges.problem:
        return [f"Errors of the range sensor are not corrected: {ranges.problem}. Check its calibration"]
    return [
        f"{range_errors.sentence(name, ranges.values[name])}: points were corrected. Calibrate the sensor to spare that"
        for name in ranges.corrected
    ] + [
        f"{range_errors.sentence(name, ranges.values[name])}{_NOT_CORRECTED[name]}" for name in ranges.noticed
    ]


def warnings_of_motion(motion: MotionLeft | None) -> list[str]:
    """That points were moved, or why not."""
    if motion is None:
        return []
    if motion.corrected and isinstance(motion.clock, RowClock):
        return [
            f"The depth camera reads the rows of a scan one after another, in {1e3 * motion.sweep:.0f} ms: "
            "points were moved by the refined trajectory"
        ]
    if motion.corrected and motion.by_rough:
        return [
            f"Scans were deskewed by the rough poses ({' and '.join(motion.by_rough)}): they were deskewed again, by the "
            "refined trajectory"
        ]
    if motion.corrected:
        return [
            f"{100 * (motion.fraction or 0.0):.1f} % of the motion during scans was left in them: points were moved by "
            "the refined trajectory. Deskew scans in the odometry to spare that"
        ]
    if not motion.problem:
        return []
    if isinstance(motion.clock, RowClock):
        return [f"Motion during the rows of depth images is not corrected: {motion.problem}"]
    return [f"Motion left in scans is not corrected: {motion.problem}. Deskew scans in the odometry"]


def of_visual(dataset: Dataset, visual: VisualStage, accepted: Accepted) -> dict[str, Any]:
    """What the visual stage did; the extrinsic is compared with the calibration."""
    if not dataset.image_paths:
        return {"accepted": None, "problem": visual.problem}
    facts: dict[str, Any] = {
        "accepted": accepted.cameras.accepted,
        "confirmed": accepted.cameras.confirmed,
        "reason": accepted.cameras.reason,
        "cause": accepted.cameras.cause,
        "judged": accepted.cameras.figures,
        "exposures_accepted": accepted.exposures.accepted,
        "exposures_reason": accepted.exposures.reason,
        "exposures_cause": accepted.exposures.cause,
        "exposures_judged": accepted.exposures.figures,
        "state": accepted.state,
    }
    result = visual.result
    if result is None:
        return facts | {"problem": visual.problem}
    change = geometry.log(dataset.camera_from_scan @ result.scan_from_camera)
    facts |= _fields(
        result,
        but=(
            *("world_from_camera", "covariance", "local_covariance", "own_covariance", "scan_from_camera"),
            *("degenerate", "log_exposure", "log_exposure_sigma", "calibration_sigma", "radiometry"),
            *("extrinsic_change", "white_balance", "clock_epoch", "group", "turns"),
        ),
    )
    if accepted.exposures.accepted:
        facts["uncertain_exposures"] = _uncertain(result)
    if result.white_balance is not None:
        size = 100 * float(np.sqrt(np.square(result.white_balance).mean()))
        facts["white_balance"] = {"used": accepted.exposures.accepted, "change_percent": size}
    facts["history"] = _history(visual)
    facts["iterations"] = len(facts["history"])
    offset = result.calibration.time_offset
    facts["time_offset"] = {"seconds": offset, "sigma": float(result.extrinsic_sigma[6])}
    facts["calibration"] = _calibration(dataset, result, accepted)
    facts |= _radiometry(result.radiometry, accepted)
    facts["extrinsic"] = {
        "scan_from_camera": result.scan_from_camera,
        "change_deg": float(np.degrees(np.linalg.norm(change[:3]))),
        "change_m": float(np.linalg.norm(change[3:])),
        "sigmas": result.extrinsic_change.sigmas,
        "certainty": result.extrinsic_change.certainty,
    }
    facts["keyframes"] = len(result.keyframes)
    last = result.levels[-1]
    facts["observations"] = last.local_pairs + last.global_pairs
    facts |= {
        name: getattr(last, name) for name in ("scene_points", "global_points", "local_pairs", "global_pairs")
    }
    facts["alike"] = last.alike / last.compared if last.compared else None
    facts["degenerate_directions"] = {"count": int(np.sum(result.degenerate)), "per_image": result.degenerate}
    return facts


def _uncertain(result: VisualResult) -> np.ndarray:
    """Images whose exposures have expected errors that are unknown or more than `verdict.UNCERTAIN` times the median, and
    large enough to be seen: of keyframes, and of those whose cameras were put where others have them."""
    asked = np.union1d(result.keyframes, result.substituted).astype(np.int64)
    sigma = result.log_exposure_sigma[asked]
    return np.asarray(asked[exposures_between.uncertain(sigma, verdict.UNCERTAIN) & (sigma > _VISIBLE)])


def _calibration(dataset: Dataset, result: VisualResult, accepted: Accepted) -> dict[str, Any]:
    """What all images share, as found, with standard deviations, and the camera that comes of it."""
    refined, sigma = result.calibration, result.calibration.layout().named(result.calibration_sigma)
    camera = self_calibration.corrected(dataset.camera, refined)
    names = ["time_offset"]
    if camera != dataset.camera or refined.readout:
        names += fixed_calibration.CORRECTIONS
    clock = {"clock_epoch": result.clock_epoch} if refined.clock_rate else {}
    names += ["clock_rate"] if clock else []
    return clock | {
        "used": accepted.cameras.accepted,
        "calibrated_camera": dataset.camera,
        "camera": camera,
        "camera_from_scan": geometry.inverse(refined.scan_from_camera),
        **{name: getattr(refined, name) for name in names},
        "sigma": {name: sigma[name] for name in ("scan_from_camera", *names)},
    }


def _radiometry(light: Radiometry, accepted: Accepted) -> dict[str, Any]:
    """How the light falls off in the images, the curve that it passes, and what nearer views seem brighter by."""
    vignette, curve = light.vignetting, light.response
    falloff = {
        "used": bool(vignette) and accepted.exposures.accepted,
        "corner_loss": vignette.corner_loss,
        "sigma": vignette.loss_sigma,
        "coefficients": vignette.coefficients,
        "center": vignette.center,
    }
    response = {
        "used": bool(curve) and accepted.exposures.accepted,
        "grey_values": GREY_VALUES,
        "slopes": curve.slopes,
        "sigma": curve.sigma,
    }
    nearer = {
        "used": bool(light.nearness) and accepted.exposures.accepted,
        "log_ratio": light.nearness.value,
        "sigma": light.nearness.sigma,
    }
    return {"vignetting": falloff, "response": response, "nearness": nearer}


def of_fusion(fused: FusionStage, accepted: Accepted) -> dict[str, Any]:
    """What the cameras changed about the scans."""
    facts: dict[str, Any] = {
        "accepted": accepted.fusion.accepted,
        "reason": accepted.fusion.reason,
        "cause": accepted.fusion.cause,
        "judged": accepted.fusion.figures,
    }
    if fused.result is not None:
        but = "world_from_scan", "covariance", "open_motions", "open_by_images", "slid", "drawn"
        facts |= _fields(fused.result, but=but)
    return facts


def _history(visual: VisualStage) -> list[dict[str, Any]]:
    """One row per iteration, with its pyramid level."""
    levels = () if visual.result is None else visual.result.levels
    return [{"level": level.level, **dataclasses.asdict(row)} for level in levels for row in level.iterations]


def of_trajectories(dataset: Dataset, accepted: Accepted) -> dict[str, Any]:
    """Positions before and after, in the input's world frame."""
    pairs = {
        "scans": (dataset.scans, accepted.world_from_scan),
        "images": (dataset.images, accepted.world_from_camera),
    }
    return {
        name: {
            "times": rough.times,
            "rough": rough.world_from_sensor[:, :3, 3] + dataset.origin,
            "refined": refined[:, :3, 3] + dataset.origin,
        }
        for name, (rough, refined) in pairs.items()
    }


def of_exposure(
    dataset: Dataset, accepted: Accepted, visual: VisualStage, reference: Reference | None
) -> dict[str, Any]:
    """Relative exposures by image, standard deviations of their logarithms about the mean, and the reference's where it
    has one for the same time."""
    if not dataset.image_paths:
        return {}
    times = dataset.images.times
    facts: dict[str, Any] = {
        "times": times,
        "relative": np.exp(accepted.log_exposure - accepted.log_exposure[0]),
    }
    if visual.result is not None and accepted.exposures.accepted:
        facts["log_sigma"] = visual.result.log_exposure_sigma
    if accepted.white_balance is not None:
        facts["white_balance"] = np.exp(accepted.white_balance)
    if reference is not None and reference.exposures is not None:
        pairs = matched(times, reference.exposures.times)
        known = np.full(len(times), np.nan)
        known[pairs[:, 0]] = reference.exposures.relative[pairs[:, 1]]
        facts["reference"] = known
    return facts


def of_evaluation(
    dataset: Dataset, scans: ScanPoses, scores: Mapping[str, Scores], state: str
) -> dict[str, Any]:
    """Scores of the input and of the result, and of the states between them."""
    if not scores:
        return {
            "rough": {**_NOTHING, "map_entropy": scans.entropy_rough},
            "refined": {**_NOTHING, "map_entropy": scans.entropy},
        }
    judged = {name: score.facts() for name, score in scores.items()}
    camera = judging_size.judging(dataset.camera)
    size = {"width": camera.width, "height": camera.height}
    return {"rough": judged[ROUGH], "refined": judged[state], "states": judged, "image_size": size}


_NOTHING = dict.fromkeys(("psnr", "ssim", "coverage", "psnr_leave_one_out", "ssim_leave_one_out"))


def _warnings(dataset: Dataset, lidar: LidarStage, visual: VisualStage, accepted: Accepted) -> list[str]:
    """What a user should know beside the verdicts of the stages, with what to do."""
    warnings = list(dataset.warnings)
    if lidar.result is not None:
        warnings += list(lidar.result.warnings)
    if visual.result is not None:
        warnings += list(visual.result.warnings)
    if dataset.image_paths and not accepted.exposures.accepted:
        warnings.append(f"Exposures: {accepted.exposures.reason}.")
    if accepted.remark:
        warnings.append(f"Result: {accepted.remark}.")
    return list(dict.fromkeys(warnings))


def _fields(value: Any, but: tuple[str, ...]) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name not in but}


def plain(value: Any) -> Any:
    """The value as JSON holds it: arrays as lists, dataclasses as objects, what is not finite as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(_fields(value, ()))
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value

"""Settings of version 0.1 that were removed, with the default that each had.

A config.yaml of that version names all of them. Where one has its old default, it is passed over: that is what runs do
today. Any other value asked for something that runs no longer do, and is an error.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

DEFAULTS: dict[str, Any] = {
    "merge.align": True,
    "merge.near_m": 8.0,
    "lidar.stages": [
        {
            "sizes": [0.5, 1.0, 2.0],
            "plane_test": {
                "ratio": 0.15,
                "finest_ratio": 0.15,
                "min_points": 16,
                "min_scans": 2,
                "excess": math.inf,
                "spread": 0.15,
                "max_tilt": 0.02,
                "two_sided": True,
            },
            "rounds": 5,
            "settled": 0.01,
            "least_gain": 0.01,
            "steps": 1,
            "exact": False,
            "systematic": 1.0,
            "hold": True,
        },
        {
            "sizes": [0.25, 0.5, 1.0],
            "plane_test": {
                "ratio": 0.08,
                "finest_ratio": 0.1,
                "min_points": 16,
                "min_scans": 2,
                "excess": 0.5,
                "spread": 0.15,
                "max_tilt": 0.02,
                "two_sided": True,
            },
            "rounds": 4,
            "settled": 0.002,
            "least_gain": 0.01,
            "steps": 1,
            "exact": False,
            "systematic": 0.3,
            "hold": True,
        },
        {
            "sizes": [0.25, 0.5, 1.0, 2.0, 4.0],
            "plane_test": {
                "ratio": 0.0625,
                "finest_ratio": 0.1111111111111111,
                "min_points": 16,
                "min_scans": 2,
                "excess": 0.15,
                "spread": 0.15,
                "max_tilt": 0.02,
                "two_sided": True,
            },
            "rounds": 8,
            "settled": 0.0001,
            "least_gain": 0.01,
            "steps": 1,
            "exact": False,
            "systematic": 0.1,
            "hold": True,
        },
    ],
    "lidar.weights.cutoff": 4.0,
    "lidar.weights.passes": 2,
    "lidar.oblique_grid": True,
    "visual.exposures": "means",
    "visual.points.patch_size": 9,
    "visual.points.min_cell_px": 8,
    "visual.points.min_points_in_image": 1000,
    "visual.points.max_points": 1000000,
    "visual.points.max_view_angle_deg": 82.0,
    "visual.points.min_score_sigma": 3.0,
    "visual.points.off_plane_part": 0.1,
    "visual.points.off_plane_sigma": 4.0,
    "visual.points.off_plane_min_m": 0.03,
    "visual.points.off_plane_max_m": 0.08,
    "visual.points.min_support": 4,
    "visual.points.extent_spacings": 3.0,
    "visual.points.min_depth_m": 0.3,
    "visual.points.occlusion_m": 0.15,
    "visual.points.occlusion_spacings": 1.5,
    "visual.points.dark": 3.0,
    "visual.points.bright": 250.0,
    "visual.points.min_usable": 0.9,
    "visual.points.tries": 12,
    "visual.visibility.use_global": True,
    "visual.visibility.score": "area",
    "visual.visibility.patch_size": 9,
    "visual.visibility.min_view_cosine": 0.17,
    "visual.visibility.max_view_angle_deg": 84.0,
    "visual.visibility.min_ncc": 0.8,
    "visual.visibility.min_scale": 0.6,
    "visual.visibility.max_scale": 3.5,
    "visual.visibility.min_std_sigma": 0.5,
    "visual.visibility.dark": 3.0,
    "visual.visibility.bright": 250.0,
    "visual.visibility.min_usable": 0.8,
    "visual.visibility.hidden_m": 0.15,
    "visual.visibility.voxel_m": 0.5,
    "visual.visibility.near_time_s": 0.5,
    "visual.visibility.near_time_m": 3.0,
    "visual.visibility.near_space_m": 0.4,
    "visual.exposure.level": 1,
    "visual.exposure.patch_size": 11,
    "visual.exposure.cells": 300,
    "visual.exposure.window": 5,
    "visual.exposure.max_view_angle_deg": 80.0,
    "visual.exposure.min_scale": 0.5,
    "visual.exposure.max_scale": 1.25,
    "visual.exposure.sigma_floor": 0.01,
    "visual.exposure.independent": 6.0,
    "visual.exposure.edge_floor": 0.0005,
    "visual.exposure.few_patches": 0.01,
    "visual.exposure.dark": 4.0,
    "visual.exposure.bright": 248.0,
    "visual.exposure.mask_reach": 1,
    "visual.exposure.hidden_m": 0.15,
    "visual.exposure.min_usable": 0.3,
    "visual.adjustment.rounds": 3,
    "visual.adjustment.solve_exposures": True,
    "visual.adjustment.plane_offsets": True,
    "visual.adjustment.plane_floor_m": 0.001,
    "visual.adjustment.photometric.patch": 9,
    "visual.adjustment.photometric.huber": 2.0,
    "visual.adjustment.photometric.least_intensity": 3.0,
    "visual.adjustment.photometric.greatest_intensity": 250.0,
    "visual.adjustment.photometric.noise_growth": 0.0,
    "visual.adjustment.photometric.reference_pixels": "fixed",
    "visual.adjustment.solver.max_iterations": 12,
    "visual.adjustment.solver.initial_damping": 0.0001,
    "visual.adjustment.solver.relative_decrease": 1e-05,
    "visual.adjustment.solver.refusals": 3,
    "visual.adjustment.solver.step_tolerance": 1e-07,
    "visual.adjustment.solver.dense_limit": 2500,
    "visual.prior.enabled": True,
    "visual.prior.sigma_position_m": 0.02,
    "visual.prior.sigma_rotation_deg": 0.3,
    "visual.prior.between_scans": 0.3,
    "visual.prior.floor_position_m": 0.001,
    "visual.prior.floor_rotation_deg": 0.01,
    "visual.prior.ceiling_position_m": 0.02,
    "visual.prior.ceiling_rotation_deg": 0.3,
    "fusion.contradiction": 5.0,
    "gate.fusion_loss": 0.05,
    "gate.contradiction": 3.0,
    "gate.min_psnr_loss": 0.1,
    "gate.min_ssim_loss": 0.005,
    "gate.scan_images": 60,
    "map.blend.tolerance": 6.0,
    "map.blend.cell_px": 4,
    "map.blend.darkest": 5.0,
    "map.blend.brightest": 250.0,
    "map.blend.noise": 2.0,
    "evaluate.colors": "paper",
    "evaluate.render.guard_images": 0,
    "evaluate.entropy.voxel_m": 0.1,
    "evaluate.entropy.min_neighbors": 10,
}
"""By dotted name."""

_ABLATION = '`python -m benchmarks.ablations "{}"` of the sources compares with that; remove the line to run'
_MENDS = {
    "merge.align": _ABLATION.format("parts side by side"),
    "visual.exposures": _ABLATION.format("without exposures"),
    "visual.visibility.use_global": _ABLATION.format("without global scene points"),
    "visual.visibility.score": _ABLATION.format("as-printed score (4)"),
    "visual.adjustment.plane_offsets": _ABLATION.format("without plane offsets"),
    "visual.adjustment.photometric.reference_pixels": _ABLATION.format(
        "reference pixels that move, as in the paper"
    ),
    "visual.prior.enabled": _ABLATION.format("without the pose prior"),
    "visual.points.patch_size": "it had no effect: set visual.patch",
    "visual.visibility.patch_size": "it had no effect: set visual.patch",
    "visual.adjustment.photometric.patch": "it had no effect: set visual.patch",
    "visual.adjustment.solve_exposures": "it had no effect: remove the line",
    "visual.adjustment.solver.max_iterations": "set visual.iterations",
    "lidar.stages": "remove it: lidar.dense_points chooses the cells, lidar.rounds how often they are made",
}


RENAMED = {
    "visual.prior.mount_position_m": "visual.prior.extrinsic_position_m",
    "visual.prior.mount_rotation_deg": "visual.prior.extrinsic_rotation_deg",
}
"""Names of earlier versions that still work, and the names that they have now."""


def with_new_names(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Nested mappings in which renamed settings have their new names; where both are given, the new one counts."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        name = RENAMED.get(f"{path}{key}")
        if name is None:
            out[key] = with_new_names(value, f"{path}{key}.") if isinstance(value, Mapping) else value
        else:
            out.setdefault(name.rsplit(".", 1)[1], value)
    out |= {key: values[key] for key in values if key in out and not isinstance(values[key], Mapping)}
    return out


def mend(name: str) -> str:
    """What to do about a value that is not the old default."""
    default = DEFAULTS[name]
    return _MENDS.get(name, f"remove the line: runs use {default!r} always")


def retired(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Name and value of each in nested mappings."""
    for key, value in values.items():
        name = f"{path}{key}"
        if name in DEFAULTS:
            yield name, value
        elif isinstance(value, Mapping):
            yield from retired(value, f"{name}.")


def without(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Nested mappings without them, and without groups that held nothing else."""
    kept: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        if name in DEFAULTS:
            continue
        if isinstance(value, Mapping) and value:
            value = without(value, f"{name}.")
            if not value:
                continue
        kept[key] = value
    return kept


def is_default(name: str, value: Any) -> bool:
    """Whether a value is the default that the setting had."""
    return _same(value, DEFAULTS[name])


def _same(value: Any, default: Any) -> bool:
    if isinstance(default, dict):
        return (
            isinstance(value, Mapping)
            and set(value) == set(default)
            and all(_same(value[k], v) for k, v in default.items())
        )
    if isinstance(default, list):
        return (
            isinstance(value, list | tuple)
            and len(value) == len(default)
            and all(_same(mine, old) for mine, old in zip(value, default, strict=True))
        )
    if isinstance(default, bool) or isinstance(value, bool):
        return value is default
    if isinstance(default, int | float):
        try:
            return float(value) == default  # YAML reads 1e-6 as text
        except (TypeError, ValueError, OverflowError):
            return False
    return bool(value == default)

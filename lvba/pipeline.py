"""The whole chain, from a recording to its colored map and report: the only place that says what follows what."""

from dataclasses import dataclass, field
from typing import ClassVar

from lvba.blocks import plan as blocks_plan
from lvba.blocks import survey
from lvba.blocks.config import MergeConfig
from lvba.blocks.split import SplitConfig, parts
from lvba.dataset import Dataset
from lvba.io.reference import Reference, of_cameras
from lvba.lidar.bundle_adjustment import LidarConfig
from lvba.plan import Passing, Plan, Ref
from lvba.products.evaluate import EvaluateConfig
from lvba.products.map_file import MapConfig
from lvba.settings import setting
from lvba.steps import evaluate as evaluate_steps
from lvba.steps import expected_error, plane_thickness, report_data, scan_acceptance
from lvba.steps.acceptance import GateConfig
from lvba.steps.fusion import solve_fusion
from lvba.steps.lidar import solve_lidar
from lvba.steps.outcomes import VisualLevel
from lvba.steps.pose_fusion import FusionConfig
from lvba.steps.products import color_map, make_pictures
from lvba.steps.visual import solve_visual, solve_visual_level, visual_levels
from lvba.visual.refine import VisualConfig
from lvba.visual.variant import PRODUCT, Variant


@dataclass(frozen=True)
class Config:
    """Every setting of a run, stage by stage."""

    KNOWS_RETIRED: ClassVar[bool] = True
    """Settings of version 0.1 that are none any more are passed over, see `lvba.retired_settings`."""

    refine_scans: bool = setting(
        True,
        meaning="Do the LiDAR bundle adjustment. false: scan poses stay as they are.",
        change_when="The scan poses are better than a LiDAR bundle adjustment could make them, as from a total station.",
    )
    refine_cameras: bool = setting(
        True,
        meaning="Do the visual bundle adjustment. false: cameras only move along with the scans.",
        change_when="Only the LiDAR map is wanted: this saves most of the time.",
    )
    split: SplitConfig = field(default_factory=SplitConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    visual: VisualConfig = field(default_factory=VisualConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    map: MapConfig = field(default_factory=MapConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)


def refine(
    dataset: Dataset,
    config: Config | None = None,
    reference: Reference | None = None,
    version: str = "",
    *,
    variant: Variant = PRODUCT,
    align_parts: bool = True,
) -> Plan:
    """From a recording to scan poses, camera poses, exposures, a colored map and the facts of the report.

    reference: poses to compare with, which decide nothing
    version: of the code, as far as it changes results
    variant, align_parts: other than by default for comparisons of the method with parts of it; a recording in parts knows
        `align_parts` only, an undivided one the variant
    """
    config = config or Config()
    reference = None if reference is None else of_cameras(reference, dataset)
    plan = Plan(version)
    cores = parts(dataset, config.split, survey.load_of(dataset))
    if len(cores) > 1:
        return blocks_plan.refine(plan, dataset, cores, config, reference, align_parts)
    lidar = plan.add("lidar", solve_lidar, dataset, config.lidar, config.refine_scans)
    scans = plan.add("lidar-gate", scan_acceptance.judge_lidar, dataset, lidar, config.evaluate, config.gate)
    coarser: Ref | VisualLevel = VisualLevel(None)
    for level in range(visual_levels(dataset, config.visual) - 1, 0, -1):
        coarser = plan.add(
            f"visual-level-{level}",
            solve_visual_level,
            *(dataset, lidar, scans, coarser, config.lidar, config.visual, config.refine_cameras, variant),
        )
    visual = plan.add(
        "visual",
        solve_visual,
        *(dataset, lidar, scans, coarser, config.lidar, config.visual, config.refine_cameras, variant),
    )
    fusion = plan.add("fusion", solve_fusion, dataset, lidar, scans, visual, config.lidar, config.fusion)
    fused = plan.add(
        "fusion-gate",
        scan_acceptance.judge_fusion,
        dataset,
        scans,
        fusion,
        config.evaluate.entropy,
        config.gate,
    )
    scores = plan.add(
        "evaluate", evaluate_steps.evaluate, dataset, scans, fused, visual, config.evaluate, config.gate
    )
    accepted = plan.add(
        "visual-gate", evaluate_steps.decide, dataset, scans, fused, visual, scores, config.gate
    )
    expected = plan.add("expected-error", expected_error.of_result, lidar, fusion, visual, accepted)
    colored = plan.add("map", color_map, dataset, accepted, expected, config.map)
    planes = plan.add("planes", plane_thickness.measure, dataset, accepted)
    plan.add("pictures", make_pictures, dataset, accepted, scores, config.evaluate)
    plan.add(
        "facts",
        report_data.collect,
        *(dataset, lidar, scans, visual, fusion, scores, accepted),
        *(expected, [Passing(colored.key)], [planes], reference),
    )
    return plan

"""The settings of a run, stage by stage."""

from dataclasses import dataclass, field
from typing import ClassVar

from lvba.blocks.merge import MergeConfig
from lvba.blocks.split import SplitConfig
from lvba.lidar.bundle_adjustment import LidarConfig
from lvba.products.evaluate import EvaluateConfig
from lvba.products.map_file import MapConfig
from lvba.settings import setting
from lvba.steps.acceptance import GateConfig
from lvba.steps.pose_fusion import FusionConfig
from lvba.visual.config import VisualConfig


@dataclass(frozen=True)
class Config:
    """Every setting of a run, stage by stage."""

    KNOWS_RETIRED: ClassVar[bool] = True
    """Settings of version 0.1 that were removed are ignored, see `lvba.retired_settings`."""

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
    remove_moving_points: bool = setting(
        True,
        meaning="Take points that other scans see through, of people, vehicles, rain, out of the map and of what images "
        "are compared with. false: keep all.",
        change_when="The map must hold all points, as to look for what moved.",
    )
    split: SplitConfig = field(default_factory=SplitConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    visual: VisualConfig = field(default_factory=VisualConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    map: MapConfig = field(default_factory=MapConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

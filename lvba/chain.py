"""What all steps of a run share: its frames in parts, what is decoded of them, and a step for each part or region."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.arrays import Indices
from lvba.blocks import scan_errors, scan_motions, split, survey
from lvba.blocks.decoded_scans import GivenScans, about_region, decode_scans, given_static
from lvba.blocks.pieces import Made, Range, given
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.plan import Plan, Ref
from lvba.run_settings import Config
from lvba.visual.variant import Variant


@dataclass
class Chain:
    """Adds the steps of one recording to a plan. parts, regions: the same tuples for all steps: each is sent once."""

    plan: Plan
    dataset: Dataset
    parts: tuple[Part, ...]
    regions: tuple[Part, ...]
    config: Config
    variant: Variant
    align: bool

    def __post_init__(self) -> None:
        self.many = len(self.parts) > 1
        self.frames = [
            split.subset(self.dataset, part.scan_numbers, part.image_numbers) if self.many else self.dataset
            for part in self.parts
        ]
        add, config, cores = self.plan.add, self.config, [part.core_scans for part in self.parts]
        self.survey = add("survey", survey.survey, self.dataset, config.lidar, config.visual.keyframes)
        measured = config.refine_scans and self.variant.scan_errors
        shared = add("sensor-errors", scan_errors.measure_shared, self.dataset, config.lidar, measured)
        motions = [
            add(
                self._name(part, "scan-motion"),
                scan_motions.measure,
                self.dataset,
                core,
                shared,
                config.lidar,
            )
            for part, core in zip(self.parts, cores, strict=True)
        ]
        self.errors = add("scan-errors", scan_motions.joined, shared, motions)
        self.photos, self.judging, self.keyframes = list[Made](), list[Made](), list[Made]()
        self.points = self._decode("scans", decode_scans, cores, self.errors, self.survey)
        self.moving, self.entropies = list[Made](), list[Ref]()

    def _decode(self, name: str, function: Any, ranges: Sequence[Range], *arguments: Any) -> list[Made]:
        """A step for each range of frames, given those of its images that were decoded before, where any were."""
        made: list[Made] = []
        for number, each in enumerate(ranges):
            held = [given(self.photos, np.arange(*each))] if self.photos else []
            own = f"{name}-{number}" if len(ranges) > 1 else name
            made.append((each, self.plan.add(own, function, self.dataset, each, *held, *arguments)))
        return made

    def _each(self, one: str, function: Any, *arguments: Any, photos: bool = True) -> list[Ref]:
        """A step for each part, given the part's frames, the part, and its scans and, if asked for, images that judge."""
        return [
            self.plan.add(self._name(part, one), function, *self._of(part, photos), *arguments)
            for part in self.parts
        ]

    def _of(self, part: Part, photos: bool = True) -> tuple[Any, ...]:
        """A part's frames, the part, and its scans and images that judge, decoded."""
        images = (given(self.judging, part.image_numbers),) if photos else ()
        return (self.frames[part.number], part, self.scans_of(part.scan_numbers), *images)

    def scans_of(self, numbers: Indices) -> list[GivenScans]:
        """Scans, ascending numbers (n,), decoded; without points that move, as soon as these are known."""
        if not self.moving:
            return list(given(self.points, numbers))
        return given_static(self.points, self.moving, numbers)

    def _each_region(
        self, one: str, function: Any, *arguments: Any, own: Callable[[Part], list[Any]] = lambda _: []
    ) -> list[Ref]:
        """A step for each region, given the recording, all regions, the number of this one, and the scans about it.

        own: further arguments of each region
        """
        return [
            self.plan.add(
                self._name(region, one), function,
                *(self.dataset, self.regions, region.number),
                *(about_region(self.dataset, region, self.points), *arguments, *own(region)),
            )
            for region in self.regions
        ]  # fmt: skip

    def _inside(self, region: Part, solved: list[Ref]) -> list[Ref]:
        """Of all parts, those whose cores are in a region."""
        first, end = region.core_scans
        return [
            ref for part, ref in zip(self.parts, solved, strict=True) if first <= part.core_scans[0] < end
        ]

    def _name(self, part: Part, one: str, many: str = "") -> str:
        return f"{many or one}-{part.number}" if self.many else one

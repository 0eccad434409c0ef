"""The chain for a recording in parts: the only place that says what follows what there."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

from lvba.blocks import camera_steps, lidar_steps, product_steps, regions, report, split, survey, visual_steps
from lvba.blocks.config import MergeConfig
from lvba.blocks.split import Frames, Part
from lvba.dataset import Dataset
from lvba.io.reference import Reference
from lvba.lidar.config import STAGES, LidarConfig
from lvba.loop_closure import candidates
from lvba.plan import Late, Passing, Plan, Ref
from lvba.products.evaluate import EvaluateConfig
from lvba.products.map_file import MapConfig
from lvba.steps import expected_error, report_data
from lvba.steps.acceptance import GateConfig
from lvba.steps.evaluate import decide
from lvba.steps.fusion import solve_fusion
from lvba.steps.outcomes import VisualLevel
from lvba.steps.pose_fusion import FusionConfig
from lvba.steps.visual import visual_levels
from lvba.visual.refine import VisualConfig


class Settings(Protocol):
    """What of `lvba.pipeline.Config` is used here."""

    @property
    def refine_scans(self) -> bool: ...
    @property
    def refine_cameras(self) -> bool: ...
    @property
    def merge(self) -> MergeConfig: ...
    @property
    def lidar(self) -> LidarConfig: ...
    @property
    def visual(self) -> VisualConfig: ...
    @property
    def fusion(self) -> FusionConfig: ...
    @property
    def gate(self) -> GateConfig: ...
    @property
    def map(self) -> MapConfig: ...
    @property
    def evaluate(self) -> EvaluateConfig: ...


def refine(
    plan: Plan,
    dataset: Dataset,
    cores: Sequence[Part],
    config: Settings,
    reference: Reference | None,
    align: bool = True,
) -> Plan:
    """The plan with all steps added, under the names that an undivided recording has for what all parts give together.

    align: False: parts stay as each of them was solved, with steps at the seams (for comparison)
    """
    cores = tuple(cores)  # one and the same for all steps: it is looked at, and sent, once
    chain = _Chain(plan, dataset, cores, config, align)
    found, scans = chain.scans()
    images, tied = chain.cameras(found, scans)
    fusion, fused = chain.fuse(found["lidar"], scans, images)
    scores, accepted = chain.judge(scans, fused, images)
    expected = plan.add("expected-error", expected_error.of_result, found["lidar"], fusion, images, accepted)
    pieces = chain.products(accepted, expected, scores)
    told = plan.add(
        "facts-of-whole", report_data.collect,
        *(dataset, found["lidar"], scans, images, fusion, scores, accepted),
        *(expected, _passing(pieces), chain.planes(accepted), reference),
    )  # fmt: skip
    walls = chain.seams(accepted)
    plan.add(
        "facts", report.collect, told, dataset, cores, found["merged"], found["joint"], tied, walls, accepted
    )
    return plan


@dataclass(frozen=True)
class _Below:
    """What visual steps over some frames stand on: the recording of these alone, its images, and the planes."""

    dataset: Dataset
    frames: Frames
    images: Ref
    ground: Ref


def _passing(found: list[Ref]) -> list[Ref]:
    """For a function that looks at one after another."""
    return [Passing(each.key) for each in found]


class _Chain:
    """Adds the steps of one recording to a plan."""

    def __init__(
        self, plan: Plan, dataset: Dataset, cores: Sequence[Part], config: Settings, align: bool
    ) -> None:
        self._plan, self._dataset, self._cores, self._config = plan, dataset, cores, config
        self._align = align
        self._subsets = [split.subset(dataset, part.scan_numbers, part.image_numbers) for part in cores]
        self._survey = plan.add("survey", survey.survey, dataset, config.lidar, config.visual.keyframes)

    def scans(self) -> tuple[dict[str, Ref], Ref]:
        """The scans of the whole recording, as they were found and as they are used."""
        add, config = self._plan.add, self._config
        solved = [
            add(f"lidar-part-{n}", lidar_steps.solve_part, frames, part, config.lidar, config.refine_scans)
            for n, (frames, part) in enumerate(zip(self._subsets, self._cores, strict=True))
        ]
        merged = add(
            "lidar-merge", lidar_steps.merge_parts,
            *(self._dataset, self._cores, solved, self._loops(solved), self._survey, self._align),
        )  # fmt: skip
        state, cells = add("lidar-start", lidar_steps.start, merged), []
        last = len(STAGES) - 1
        for stage, rounds in ((last - 1, config.merge.coarse_rounds), (last, config.merge.scan_rounds)):
            if stage < 0 or (rounds == 0 and stage < last):
                continue
            cells = self._cells(state, stage, rounds)
            for turn in range(rounds):
                state = self._round(cells, state, stage, turn)
        account = [
            add(
                f"lidar-account-{n}",
                lidar_steps.linearize_share,
                self._dataset,
                Late(own.key),
                state,
                self._survey,
                last,
                final=True,
            )
            for n, own in enumerate(cells)
        ]
        joint = add(
            "lidar-joint", lidar_steps.finish_scans, merged, state, _passing(account), solved, self._survey
        )
        whole = add("lidar", lidar_steps.stage_of, joint)
        entropies = [
            add(
                f"lidar-entropy-{part.number}", regions.judge_region,
                *(self._dataset, self._cores, part.number, whole, self._survey, config.evaluate.entropy),
            )
            for part in self._cores
        ]  # fmt: skip
        compared = [
            add(
                f"lidar-images-{part.number}", product_steps.compare_part,
                *(frames, part, len(self._dataset.image_paths), whole, config.evaluate, config.gate),
            )
            for frames, part in zip(self._subsets, self._cores, strict=True)
        ]  # fmt: skip
        images = add("lidar-images", product_steps.merge_compared, compared)
        scans = add("lidar-gate", regions.judge_scans, self._dataset, whole, entropies, images, config.gate)
        return {"merged": merged, "joint": joint, "lidar": whole}, scans

    def _loops(self, solved: list[Ref]) -> list[Ref]:
        if not (self._config.merge.loops and self._config.refine_scans):
            return []
        found = candidates.candidates(
            self._dataset.scans.world_from_sensor, tuple(part.scan_numbers for part in self._cores)
        )
        return [
            self._plan.add(
                f"lidar-loop-{each.first}-{each.second}-{number}",
                lidar_steps.close_loop, solved[each.first], solved[each.second], each,
            )
            for number, each in enumerate(found)
        ]  # fmt: skip

    def _cells(self, state: Ref, stage: int, rounds: int) -> list[Ref]:
        return [
            self._plan.add(
                f"lidar-cells-{stage}-{part.number}", lidar_steps.collect_share,
                *(self._dataset, self._cores, part.number, state, self._survey, stage if rounds else stage + 1),
            )
            for part in self._cores
        ]  # fmt: skip

    def _round(self, cells: list[Ref], state: Ref, stage: int, turn: int) -> Ref:
        name = f"{stage}-{turn}"
        found = [
            self._plan.add(
                f"lidar-share-{name}-{n}",
                lidar_steps.linearize_share,
                self._dataset,
                Late(own.key),
                state,
                self._survey,
                stage,
            )
            for n, own in enumerate(cells)
        ]
        return self._plan.add(
            f"lidar-step-{name}", lidar_steps.step_scans, state, _passing(found), self._survey, stage
        )

    def cameras(self, found: dict[str, Ref], scans: Ref) -> tuple[Ref, Ref]:
        """The cameras of the whole recording, and how the parts fitted."""
        add, config = self._plan.add, self._config
        below: list[_Below] = []
        solved = []
        for frames, part in zip(self._subsets, self._cores, strict=True):
            below.append(self._below(str(part.number), frames, part.frames, found["joint"], scans))
            solved.append(self._part_cameras(part, below[-1]))
        merged = add(
            "visual-merge", camera_steps.merge_cameras,
            *(self._dataset, self._cores, solved, found["joint"], scans, self._survey, config.visual, self._align),
        )  # fmt: skip
        merged = self._joint_cameras(below, solved, merged, found["joint"], scans)
        whole = add(
            "visual", camera_steps.finish_cameras,
            *(self._dataset, self._cores, solved, merged, found["joint"], scans, self._survey, config.visual),
        )  # fmt: skip
        return whole, merged

    def _below(self, name: str, dataset: Dataset, frames: Frames, joint: Ref, scans: Ref) -> "_Below":
        add, config = self._plan.add, self._config
        images = add(
            f"images-{name}", visual_steps.undistorted,
            *(dataset, frames, self._survey, config.visual.images, config.refine_cameras),
        )  # fmt: skip
        ground = add(f"ground-{name}", visual_steps.ground, dataset, frames, joint, scans, self._survey)
        return _Below(dataset, frames, images, ground)

    def _joint_cameras(
        self, below: "list[_Below]", solved: list[Ref], merged: Ref, joint: Ref, scans: Ref
    ) -> Ref:
        add, config = self._plan.add, self._config
        if config.merge.image_rounds == 0:
            return merged
        both = [
            (self._with_near(part, own, joint, scans), found)
            for part, own, found in zip(self._cores, below, solved, strict=True)
        ]
        laid = [
            add(
                f"visual-points-{number}", camera_steps.lay_out,
                *(near.dataset, near.frames, near.images, near.ground, found, merged, self._survey, config.visual),
            )
            for number, (near, found) in enumerate(both)
        ]  # fmt: skip
        # apart from the points: of those only one part's are in memory at a time
        brightness = [
            add(f"visual-brightness-{part.number}", camera_steps.brightness, points)
            for part, points in zip(self._cores, laid, strict=True)
        ]
        merged = add("visual-exposures", camera_steps.tie_exposures, merged, brightness)
        for turn in range(config.merge.image_rounds):
            shares = [
                add(
                    f"visual-share-{turn}-{number}", camera_steps.linearize_cameras,
                    *(near.dataset, Late(near.images.key), found, Late(points.key), merged, config.visual),
                )
                for number, ((near, found), points) in enumerate(zip(both, laid, strict=True))
            ]  # fmt: skip
            merged = add(f"visual-step-{turn}", camera_steps.step_cameras, merged, shares)
        return merged

    def _with_near(self, part: Part, own: "_Below", joint: Ref, scans: Ref) -> "_Below":
        """A part's frames with those that others took at the same place, and the planes of all of them."""
        frames = split.with_near(self._dataset, part, self._config.merge.near_m)
        if len(frames.images) == len(part.image_numbers):
            return own
        dataset = split.subset(self._dataset, frames.scans, frames.images)
        return self._below(f"with-near-{part.number}", dataset, frames, joint, scans)

    def _part_cameras(self, part: Part, below: "_Below") -> Ref:
        config, frames = self._config, below.dataset
        coarser: Ref | VisualLevel = VisualLevel(None)
        for level in range(visual_levels(frames, config.visual) - 1, 0, -1):
            coarser = self._plan.add(
                f"visual-level-{level}-part-{part.number}", visual_steps.solve_level,
                *(frames, below.images, below.ground, coarser, config.visual, config.refine_cameras),
            )  # fmt: skip
        return self._plan.add(
            f"visual-part-{part.number}", visual_steps.solve_part,
            *(frames, below.images, below.ground, coarser, config.visual, config.refine_cameras),
        )  # fmt: skip

    def fuse(self, found: Ref, scans: Ref, images: Ref) -> tuple[Ref, Ref]:
        """What the cameras say about the scans, and the scans as they are used with the cameras."""
        add, config = self._plan.add, self._config
        fusion = add("fusion", solve_fusion, self._dataset, found, scans, images, config.lidar, config.fusion)
        entropies = [
            add(
                f"fusion-entropy-{part.number}", regions.fused_entropy,
                *(self._dataset, self._cores, part.number, fusion, self._survey, config.evaluate.entropy),
            )
            for part in self._cores
        ]  # fmt: skip
        return fusion, add("fusion-gate", regions.judge_fusion, scans, fusion, entropies, config.gate)

    def judge(self, scans: Ref, fused: Ref, images: Ref) -> tuple[Ref, Ref]:
        """The scores over all images, and the state that is the result."""
        add, config = self._plan.add, self._config
        scores = [
            add(
                f"evaluate-{part.number}", product_steps.evaluate_part,
                frames, part, len(self._dataset.image_paths), scans, fused, images, config.evaluate,
            )
            for frames, part in zip(self._subsets, self._cores, strict=True)
        ]  # fmt: skip
        whole = add("evaluate", product_steps.merge_scores, scores, scans, fused)
        return whole, add("visual-gate", decide, self._dataset, scans, fused, images, whole, config.gate)

    def seams(self, accepted: Ref) -> list[Ref]:
        """How thick walls are across each seam."""
        return [
            self._plan.add(
                f"seam-{left.number}-{right.number}", product_steps.measure_seam,
                product_steps.seam_frames(self._dataset, left, right), left, right, accepted,
            )
            for left, right in pairwise(self._cores)
        ]  # fmt: skip

    def planes(self, accepted: Ref) -> list[Ref]:
        """How thick planes are before and after, region by region."""
        return [
            self._plan.add(
                f"planes-{part.number}", regions.thickness,
                *(self._dataset, self._cores, part.number, accepted, self._survey),
            )
            for part in self._cores
        ]  # fmt: skip

    def products(self, accepted: Ref, expected: Ref, scores: Ref) -> list[Ref]:
        """The map, whose pieces nobody needs to have together, and the pictures; the pieces come back."""
        add, config = self._plan.add, self._config
        pieces = [
            add(
                f"map-{part.number}", product_steps.color_part,
                *(frames, part, self._dataset, self._cores, accepted, expected, self._survey, config.map),
            )
            for frames, part in zip(self._subsets, self._cores, strict=True)
        ]  # fmt: skip
        choice = add("pictures-choice", product_steps.choose_pictures, scores, accepted)
        shown: list[Any] = [
            add(
                f"pictures-{part.number}",
                product_steps.show_part,
                frames,
                part,
                accepted,
                choice,
                config.evaluate,
            )
            for frames, part in zip(self._subsets, self._cores, strict=True)
        ]
        add("pictures", product_steps.collect_pictures, choice, shown)
        return pieces

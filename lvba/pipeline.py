"""The sequence of steps of a run: the only place that says what follows what.

A recording is refined in parts, and most have one: then what that part gives is the result, and the steps that merge
parts and solve them jointly are not in the plan.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lvba.blocks import decoded_images, split, survey
from lvba.blocks.pieces import Given, given
from lvba.blocks.split import Frames, Load, Part
from lvba.chain import Chain
from lvba.dataset import Dataset
from lvba.io.reference import Reference, of_cameras
from lvba.lidar.config import STAGES
from lvba.loop_closure import candidates
from lvba.plan import LazyRef, Plan, Ref, one_at_a_time
from lvba.run_settings import Config as Config
from lvba.steps import (
    between_exposures,
    camera_choice,
    camera_outliers,
    evaluate,
    expected_error,
    fused_cameras,
    fusion,
    joint_cameras,
    joint_scans,
    lidar,
    merge_data,
    moving_points,
    plane_thickness,
    products,
    report_data,
    scan_acceptance,
    seams,
    visual,
)
from lvba.steps.outcomes import VisualLevel
from lvba.visual.variant import PRODUCT, Variant


def refine(
    dataset: Dataset,
    config: Config | None = None,
    reference: Reference | None = None,
    version: str = "",
    *,
    variant: Variant = PRODUCT,
    align_parts: bool = True,
    load: Load | None = None,
) -> Plan:
    """From a recording to scan poses, camera poses, exposures, a colored map and the facts of the report.

    reference: poses to compare with, which decide nothing
    version: of the code, as far as it changes results
    variant: parts of the method left out, for comparisons
    align_parts: False: parts stay as each of them was solved, with steps at the seams, for comparisons; of one part,
        nothing changes
    load: what the recording asks of memory, where that is known already
    Raises ValueError: a variant with joint rounds of cameras, which solve the full problem only.
    """
    config = config or Config()
    reference = None if reference is None else of_cameras(reference, dataset)
    load = load or survey.load_of(dataset)
    parts = tuple(split.parts(dataset, config.split, load))
    if len(parts) > 1 and variant != PRODUCT and config.merge.image_rounds > 0:
        raise ValueError("a variant of a recording in parts needs merge.image_rounds = 0")
    chain = _Chain(
        plan=Plan(version), dataset=dataset, parts=parts, regions=split.regions(parts, load), config=config,
        variant=variant, align=align_parts,
    )  # fmt: skip
    chain.add(reference)
    return chain.plan


@dataclass(frozen=True)
class _Images:
    """Frames that visual steps work on: the recording of these alone, their keyframes, and the planes they are over."""

    dataset: Dataset
    frames: Frames
    keyframes: list[Given]
    planes: Ref


@dataclass(frozen=True)
class _Merged:
    """What steps that only a run in parts has leave for the report: parts merged, scans and cameras solved jointly."""

    scans: Ref
    joint: Ref
    cameras: Ref | None = None


class _Chain(Chain):
    """The steps of one recording."""

    def add(self, reference: Reference | None) -> None:
        """All steps: the sequence of a run."""
        add = self.plan.add
        lidar, scans, merged = self.solve_scans()
        solved, merged = self.solve_cameras(lidar, scans, merged)
        cameras = self.mend_cameras(scans, solved)
        learned, fused = self.fuse(lidar, scans, cameras)
        cameras = self.solve_over_fused(lidar, learned, fused, cameras)
        cameras = self.expose_between(scans, cameras)
        scores, accepted = self.choose(scans, fused, cameras)
        expected = add("expected-error", expected_error.of_result, lidar, learned, cameras, accepted)
        pieces = self.color_map(accepted, expected)
        planes = self.measure_planes(accepted)
        self.show_images(accepted, scores)
        facts = self.merge_facts(merged, accepted)
        add(
            "facts", report_data.collect,
            *(self.dataset, lidar, scans, cameras, learned, scores, accepted),
            *(expected, one_at_a_time(pieces), planes, reference, facts, self.errors),
            moving=[ref for _, ref in self.moving],
        )  # fmt: skip

    def solve_scans(self) -> tuple[Ref, Ref, _Merged | None]:
        """The scans of the whole recording, as they were found and as they are used."""
        config = self.config
        merged = None
        if self.many:
            solved, merged = self._solve_scans_jointly()
        else:
            [solved] = self._each(
                "lidar", lidar.solve_lidar, config.lidar, config.refine_scans, self.errors, photos=False
            )
        entropies = self.entropies = self._each_region(
            "lidar-entropy", scan_acceptance.measure_entropy, solved, self.survey, config.evaluate.entropy
        )
        if config.remove_moving_points:
            moving = self._each("moving-points", moving_points.find, solved, photos=False)
            self.moving = [(part.core_scans, ref) for part, ref in zip(self.parts, moving, strict=True)]
        cores = [part.core_images for part in self.parts]
        full, judging = decoded_images.photo_ranges(self.dataset.camera, cores)
        self.photos = self.judging = self._decode("photos", decoded_images.decode_photos, full)
        if judging:
            self.judging = self._decode("photos-judging", decoded_images.judging_photos, judging)
        compared = self._each(
            "lidar-images", scan_acceptance.compare,
            *(len(self.dataset.image_paths), solved, entropies, config.evaluate, config.gate, config.visual.prior),
        )  # fmt: skip
        scans = self.plan.add(
            "lidar-gate", scan_acceptance.judge_lidar, self.dataset, solved, entropies, compared, config.gate
        )
        return solved, scans, merged

    def _solve_scans_jointly(self) -> tuple[Ref, _Merged]:
        """The parts solved, merged, and solved jointly in rounds."""
        add, config = self.plan.add, self.config
        solved = self._each(
            "lidar-part", joint_scans.solve_part, config.lidar, config.refine_scans, photos=False
        )
        merged = add(
            "lidar-merge", joint_scans.merge_parts,
            *(self.dataset, self.parts, solved, self._loops(solved), self.survey, self.align),
        )  # fmt: skip
        state, clusters, last = add("lidar-start", joint_scans.start, merged), [], len(STAGES) - 1
        for stage, rounds in ((last - 1, config.merge.coarse_rounds), (last, config.merge.scan_rounds)):
            if stage < 0 or (rounds == 0 and stage < last):
                continue
            clusters = self._each_region(
                f"lidar-clusters-{stage}", joint_scans.collect_clusters,
                *(state, self.survey, stage if rounds else stage + 1),
                own=lambda region: [one_at_a_time(self._inside(region, solved))],
            )  # fmt: skip
            for turn in range(rounds):
                equations = self._linearize(f"lidar-linearize-{stage}-{turn}", clusters, state, stage)
                state = add(
                    f"lidar-step-{stage}-{turn}", joint_scans.step_scans,
                    *(state, one_at_a_time(equations), self.survey, stage),
                )  # fmt: skip
        final = self._linearize("lidar-linearize-final", clusters, state, last, final=True)
        joint = add(
            "lidar-joint", joint_scans.finish_scans,
            *(merged, state, one_at_a_time(final), solved, self.survey, self.errors),
        )  # fmt: skip
        return add("lidar", joint_scans.stage_of, joint), _Merged(merged, joint)

    def _linearize(
        self, name: str, clusters: list[Ref], state: Ref, stage: int, **options: bool
    ) -> list[Ref]:
        return [
            self.plan.add(
                f"{name}-{number}", joint_scans.linearize_scans,
                *(self.dataset, LazyRef(own.key), state, self.survey, stage), **options,
            )
            for number, own in enumerate(clusters)
        ]  # fmt: skip

    def _loops(self, solved: list[Ref]) -> list[Ref]:
        if not (self.config.merge.loops and self.config.refine_scans):
            return []
        pairs = candidates.candidates(
            self.dataset.scans.world_from_sensor, tuple(part.scan_numbers for part in self.parts)
        )
        return [
            self.plan.add(
                f"lidar-loop-{each.first}-{each.second}-{number}",
                joint_scans.close_loop, solved[each.first], solved[each.second], each,
            )
            for number, each in enumerate(pairs)
        ]  # fmt: skip

    def solve_cameras(self, lidar: Ref, scans: Ref, merged: _Merged | None) -> tuple[Ref, _Merged | None]:
        """The cameras of the whole recording."""
        options = self.survey, self.config.visual.images, self.config.refine_cameras
        cores = [part.core_images for part in self.parts if self.dataset.image_paths]
        self.keyframes = self._decode("images", decoded_images.keyframes_of_photos, cores, *options)
        wanted = self.config.refine_cameras
        self.images = [self._images_of(part, lidar, scans, wanted) for part in self.parts]
        self.solved = self._solve_parts(lidar, scans)
        if merged is None:
            return self.solved[0], None
        tied = self.plan.add(
            "visual-merge", joint_cameras.merge_cameras,
            *(self.dataset, self.parts, self.solved, lidar, scans, self.survey, self.config.visual, self.align),
        )  # fmt: skip
        tied = self._solve_cameras_jointly(self.images, tied, lidar, scans, wanted)
        cameras = self.plan.add(
            "visual", joint_cameras.finish_cameras,
            *(self.dataset, self.parts, self.solved, tied, lidar, scans, self.survey, self.config.visual),
        )  # fmt: skip
        return cameras, replace(merged, cameras=tied)

    def _images_of(
        self, part: Part, lidar: Ref, scans: Ref, wanted: Ref | bool, over: str = "visual"
    ) -> _Images:
        name = f"{over}-planes{self._name(part, '')}"
        return self._images(name, self.frames[part.number], part.frames, lidar, scans, wanted)

    def _images(
        self, name: str, dataset: Dataset, frames: Frames, lidar: Ref, scans: Ref, wanted: Ref | bool
    ) -> _Images:
        planes = self.plan.add(
            name, visual.find_planes,
            *(dataset, frames, self.scans_of(frames.scans), lidar, scans, self.survey, wanted),
        )  # fmt: skip
        return _Images(dataset, frames, given(self.keyframes, frames.images), planes)

    def _solve_parts(self, lidar: Ref, scans: Ref) -> list[Ref]:
        """The cameras of each part, with the camera that images speak for: as they correct it, or as calibrated."""
        add, config = self.plan.add, self.config
        both = [self._solve_part(part, own, lidar) for part, own in zip(self.parts, self.images, strict=True)]
        compared = [
            add(
                self._name(part, "visual-compared"), camera_choice.compare,
                *self._of(part), len(self.dataset.image_paths), scans, *solved, config.evaluate,
            )
            for part, solved in zip(self.parts, both, strict=True)
        ]  # fmt: skip
        return [
            add(self._name(part, "visual-choice"), camera_choice.choose, *solved, compared, config.gate)
            for part, solved in zip(self.parts, both, strict=True)
        ]

    def _solve_part(self, part: Part, images: _Images, lidar: Ref) -> tuple[Ref, Ref]:
        """With the camera as images correct it, and as calibrated."""
        config, coarser = self.config, VisualLevel(None)
        level: Ref | VisualLevel = coarser
        for number in range(visual.visual_levels(images.dataset, config.visual) - 1, 0, -1):
            level = self.plan.add(
                self._name(part, f"visual-level-{number}", f"visual-level-{number}-part"), visual.solve_level,
                *(images.dataset, images.frames, images.keyframes, lidar, images.planes, level),
                *(config.visual, self.variant),
            )  # fmt: skip
        photos = [given(each, part.image_numbers) for each in (self.photos, self.judging)]
        own, options = (
            (images.dataset, images.frames, images.keyframes),
            (config.visual, self.variant, *photos),
        )
        solved = self.plan.add(
            self._name(part, "visual", "visual-part"), visual.solve_finest,
            *(*own, lidar, images.planes, level, *options),
        )  # fmt: skip
        calibrated = self.plan.add(
            self._name(part, "visual-as-calibrated"), visual.solve_as_calibrated,
            *(*own, lidar, images.planes, level, solved, *options),
        )  # fmt: skip
        return solved, calibrated

    def _solve_cameras_jointly(
        self,
        images: list[_Images],
        merged: Ref,
        lidar: Ref,
        scans: Ref,
        wanted: Ref | bool,
        over: str = "visual",
    ) -> Ref:
        """The cameras of all parts, solved in rounds. over: which planes these are over, in the names of steps"""
        add, config = self.plan.add, self.config
        if config.merge.image_rounds == 0:
            return merged
        near = [
            self._with_near(part, own, lidar, scans, wanted, over)
            for part, own in zip(self.parts, images, strict=True)
        ]
        numbered = list(enumerate(zip(near, self.solved, strict=True)))
        points = [
            add(
                f"{over}-points-{number}", joint_cameras.select_points,
                *(seen.dataset, seen.frames, seen.keyframes, lidar, seen.planes, part, merged),
                *(self.survey, config.visual),
            )
            for number, (seen, part) in numbered
        ]  # fmt: skip
        # apart from the points: of those only one part's are in memory at a time
        pairs = [
            add(f"{over}-exposure-pairs-{number}", joint_cameras.exposure_pairs, each)
            for number, each in enumerate(points)
        ]
        merged = add(f"{over}-exposures", joint_cameras.solve_exposures, merged, pairs)
        for turn in range(config.merge.image_rounds):
            equations = [
                add(
                    f"{over}-linearize-{turn}-{number}", joint_cameras.linearize_cameras,
                    *(seen.dataset, seen.keyframes, part, LazyRef(points[number].key), merged),
                    *(self.survey, config.visual),
                )
                for number, (seen, part) in numbered
            ]  # fmt: skip
            merged = add(f"{over}-step-{turn}", joint_cameras.step_cameras, merged, equations)
        return merged

    def _with_near(
        self, part: Part, own: _Images, lidar: Ref, scans: Ref, wanted: Ref | bool, over: str
    ) -> _Images:
        """A part's frames with those that others took at the same place, and the planes of all of them."""
        frames = split.with_near(self.dataset, part)
        if len(frames.images) == len(part.image_numbers):
            return own
        dataset = split.subset(self.dataset, frames.scans, frames.images)
        name = f"{over}-planes-with-near-{part.number}"
        return self._images(name, dataset, frames, lidar, scans, wanted)

    def mend_cameras(self, scans: Ref, solved: Ref) -> Ref:
        """The cameras without outliers."""
        state = self.dataset, scans, solved
        compared = self._each("visual-outliers", camera_outliers.compare, *state, self.config.evaluate)
        return self.plan.add("visual-mended", camera_outliers.mend, *state, compared)

    def fuse(self, lidar: Ref, scans: Ref, cameras: Ref) -> tuple[Ref, Ref]:
        """What the cameras say about the scans, and the scans as they are used with the cameras."""
        add, config = self.plan.add, self.config
        learned = add("fusion", fusion.solve_fusion, self.dataset, lidar, scans, cameras, config.fusion)
        entropies = self._each_region(
            "fusion-entropy", scan_acceptance.measure_fused_entropy,
            *(learned, self.survey, config.evaluate.entropy),
            own=lambda region: [self.entropies[region.number]],
        )  # fmt: skip
        judged = scans, learned, entropies, config.gate
        learned = add("fusion-choice", scan_acceptance.choose_fusion, *judged)
        fused = add("fusion-gate", scan_acceptance.judge_fusion, scans, learned, entropies, config.gate)
        return learned, fused

    def solve_over_fused(self, lidar: Ref, learned: Ref, fused: Ref, cameras: Ref) -> Ref:
        """The cameras, solved further over the planes at the scans refined with them."""
        if self.variant != PRODUCT:  # rounds solve the full problem only
            return cameras
        add, options = self.plan.add, (self.survey, self.config.visual)
        if not self.many:
            [own], [stage], [part] = self.images, self.solved, self.parts
            return add(
                "fused-cameras", fused_cameras.solve_alone,
                *(own.dataset, own.frames, self.scans_of(own.frames.scans), own.keyframes, stage),
                *(cameras, lidar, learned, fused, part, *options, self.config.merge.image_rounds),
            )  # fmt: skip
        merged = add(
            "fused-start", fused_cameras.start,
            *(self.dataset, self.parts, self.solved, cameras, lidar, learned, fused, *options),
        )  # fmt: skip
        wanted = add("fused-wanted", fused_cameras.are_solved, merged)
        bare = add("fused-lidar", fused_cameras.without_planes, lidar)
        images = [self._images_of(part, bare, fused, wanted, "fused") for part in self.parts]
        merged = self._solve_cameras_jointly(images, merged, bare, fused, wanted, "fused")
        return add(
            "fused-cameras", fused_cameras.finish,
            *(self.dataset, self.solved, cameras, merged, lidar, fused, *options),
        )  # fmt: skip

    def expose_between(self, scans: Ref, cameras: Ref) -> Ref:
        """The cameras with the exposures of images between keyframes as the map shows them."""
        if self.variant.exposures == "none":
            return cameras
        parts = self._each(
            "exposures-between", between_exposures.measure, scans, cameras, self.config.evaluate
        )
        return self.plan.add("exposures", between_exposures.merge, cameras, parts)

    def choose(self, scans: Ref, fused: Ref, cameras: Ref) -> tuple[Ref, Ref]:
        """The scores over all images, and the state that is the result."""
        add, config = self.plan.add, self.config
        states = len(self.dataset.image_paths), scans, fused, cameras
        parts = self._each("evaluate", evaluate.evaluate, *states, config.evaluate, config.gate)
        scores = self._together("evaluate", parts, scans, fused)
        accepted = add("visual-gate", evaluate.decide, self.dataset, *states[1:], scores, config.gate)
        name, complete, options = "evaluate-result", evaluate.complete, (accepted, config.evaluate)
        completed = [
            add(self._name(part, name), complete, *self._of(part), *states, own, *options)
            for part, own in zip(self.parts, parts, strict=True)
        ]
        return self._together(name, completed, scans, fused), accepted

    def _together(self, name: str, parts: list[Ref], scans: Ref, fused: Ref) -> Ref:
        """The scores of all parts as one."""
        return self.plan.add(name, evaluate.merge_scores, parts, scans, fused) if self.many else parts[0]

    def color_map(self, accepted: Ref, expected: Ref) -> list[Ref]:
        """The map, in pieces that nobody needs to have together."""
        return self._each(
            "map", products.color_map,
            *(self.dataset, self.parts, accepted, expected, self.survey, self.config.map),
        )  # fmt: skip

    def measure_planes(self, accepted: Ref) -> list[Ref]:
        """How thick planes are before and after, region by region."""
        return self._each_region("planes", plane_thickness.measure, accepted, self.survey)

    def show_images(self, accepted: Ref, scores: Ref) -> None:
        """The pictures of the report."""
        shown = self._each("renderings", products.show_images, accepted, scores, self.config.evaluate)
        self.plan.add("pictures", products.collect_pictures, scores, accepted, shown)

    def merge_facts(self, merged: _Merged | None, accepted: Ref) -> Ref | None:
        """How the parts fitted, with the walls across each seam."""
        if merged is None:
            return None
        walls = [
            self.plan.add(
                f"seam-{left.number}-{right.number}", seams.measure_seam,
                *(seams.seam_frames(self.dataset, left, right), left, right),
                *(given(self.points, np.arange(left.core_scans[0], right.core_scans[1])), accepted),
            )
            for left, right in pairwise(self.parts)
        ]  # fmt: skip
        return self.plan.add(
            "merge-facts", merge_data.collect,
            *(self.dataset, self.parts, merged.scans, merged.joint, merged.cameras, walls, accepted),
        )  # fmt: skip

"""One sequence of steps, for one part and for many."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lvba
from lvba import config, pipeline
from lvba.blocks.split import Load, SplitConfig
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.pipeline import Config
from lvba.trajectory import Trajectory
from lvba.visual.variant import Variant

JOINT = ("joint_scans", "joint_cameras", "fused_cameras", "seams", "merge_data")
"""Modules whose steps only a run in parts has, but for `fused_cameras.solve_alone`."""


@pytest.fixture
def plan_of(monkeypatch):
    """The plan of a recording along a line, cut into cores of so many scans, or not at all."""
    monkeypatch.setattr(pipeline.survey, "load_of", lambda _: Load(30_000, 640 * 480))
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = np.arange(60.0)
    path = Trajectory(np.arange(60.0), poses)
    names = tuple(map(str, range(60)))
    camera = RigCamera(Camera(640, 480, 500, 500, 320, 240), np.eye(4))
    dataset = Dataset("line", names, path, names, path, (camera,))

    def make(size, settings=None, **options):
        split = SplitConfig(by="count", size=size) if size else SplitConfig(by="none")
        return pipeline.refine(dataset, replace(settings or Config(), split=split), **options)

    return make


def functions(plan):
    return {step.function for step in plan.steps.values()}


def test_one_part_takes_the_steps_that_many_take_without_the_joint_ones(plan_of):
    one, many = functions(plan_of(0)), functions(plan_of(20))
    # in parts, `solve_part` calls the one, and the other is several joint steps (tests/steps/test_fused_cameras.py)
    assert {function.__name__ for function in one - many} == {"solve_lidar", "solve_alone"}
    joint = {function for function in many if function.__module__.rpartition(".")[2] in JOINT}
    assert {function.__name__ for function in many - joint - one} == {"merge_scores"}


def test_steps_of_whole_recordings_have_the_same_names_in_parts(plan_of):
    one, many = ({step.name for step in plan_of(size).steps.values()} for size in (0, 20))
    per_part = one - many
    assert {f"{name}-{part}" for name in per_part for part in range(3)} <= {
        name.replace("-part-", "-") for name in many
    }
    assert {"lidar", "lidar-gate", "visual", "fusion", "visual-gate", "pictures", "facts"} <= one & many


def test_no_other_module_adds_steps():
    folder = Path(lvba.__file__).parent
    makers = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Plan":
                makers.add(path.relative_to(folder).as_posix())
            if isinstance(node, ast.ClassDef) and node.name == "Plan":
                makers.add(path.relative_to(folder).as_posix())
    assert makers == {"plan.py", "pipeline.py"}


def test_a_variant_of_parts_with_joint_rounds_is_refused(plan_of):
    variant = Variant(global_points=False)
    assert plan_of(0, variant=variant).steps.keys() != plan_of(0).steps.keys()
    with pytest.raises(ValueError, match=r"merge\.image_rounds = 0"):
        plan_of(20, variant=variant)


def test_every_ablation_has_a_plan_of_its_own(plan_of, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(lvba.__file__).parent.parent))
    from benchmarks.ablations import ABLATIONS, MODELS

    every = ABLATIONS | MODELS

    def keys(name):
        ablation = every[name]
        settings = config.override(Config(), list(ablation.settings))
        made = plan_of(0, settings=settings, variant=ablation.variant, align_parts=ablation.align_parts)
        return frozenset(made.steps)

    # parts are aligned, or not, where there are several
    alone = [name for name in every if name != "parts side by side"]
    assert len({keys(name) for name in alone}) == len(alone) > 17
    assert plan_of(20, align_parts=False).steps.keys() != plan_of(20).steps.keys()

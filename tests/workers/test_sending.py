"""What goes to workers: little for each step, however long the plan; and what a process keeps of it."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from lvba import plan
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.pipeline import Config
from lvba.plan import Plan, Ref
from lvba.trajectory import Trajectory
from workers import sending, task
from workers.sending import Sender
from workers.store import ZarrStore


def recording(name, scans=40):
    poses = Trajectory(np.arange(float(scans)), np.tile(np.eye(4), (scans, 1, 1)))
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    paths = tuple(f"/data/{i:06}.pcd" for i in range(scans))
    return Dataset("/data", paths, poses, (), empty, (), digest=f"digest-{name}")


def work_on(*arguments, **options):
    return None


def parts(count):
    """A plan of `count` parts; each step names its own part, and the cores of all."""
    work = Plan("1")
    config = Config()
    cores = [Part(i, (i, i + 3), (i, i + 1), (0, 0), (0, 0)) for i in range(count)]
    frames = [recording(i) for i in range(count)]
    solved = [
        work.add(f"solve-{i}", work_on, frame, core, config)
        for i, (frame, core) in enumerate(zip(frames, cores, strict=True))
    ]
    for i, own in enumerate(solved):
        work.add(f"share-{i}", work_on, own, cores, i, config=config, final=True)
    work.add("merge", work_on, solved, np.arange(1000.0), {"all": [solved, (1, "x")]})
    return work


def resolved(step, store):
    return plan.resolve(list(step.args), store), plan.resolve(dict(step.kwargs), store)


def test_worker_gets_the_same_arguments(tmp_path):
    store, work = ZarrStore(tmp_path), parts(3)
    for number, step in enumerate(work.steps.values()):
        store[step.key] = number
    sender = Sender(work, store)
    for step in work.steps.values():
        outline = sender.outline(step)
        received = sending.receive(outline, step.key, step.function)
        assert (received.name, received.key, received.function) == (step.name, step.key, step.function)
        got, expected = resolved(received, ZarrStore(tmp_path)), resolved(step, store)
        assert plan.identity(got) == plan.identity(expected)
        assert set(step.needs) <= set(received.needs)


def test_what_a_task_is_told_and_reads_does_not_grow_with_the_plan(tmp_path):
    told = {}
    for count in (2, 200):
        work = parts(count)
        sender = Sender(work, ZarrStore(tmp_path / str(count)))
        told[count] = [
            len(sender.outline(step)) for step in work.steps.values() if step.name in ("solve-1", "share-1")
        ]
        assert max(told[count]) < 1000
        (step,) = (s for s in work.steps.values() if s.name == "solve-1")
        received = sending.receive(sender.outline(step), step.key, step.function)
        sizes = [
            sum(p.stat().st_size for p in (tmp_path / str(count) / key).rglob("*") if p.is_file())
            for key in received.needs
        ]
        told[count].append(sum(sizes))
    assert told[200] == pytest.approx(told[2], rel=0.02)


def test_each_thing_is_sent_once_and_only_when_a_step_needs_it(tmp_path):
    work = parts(5)
    sender = Sender(work, ZarrStore(tmp_path))
    assert [key.split("-")[0] for key in ZarrStore(tmp_path)] == ["plan"]
    for step in work.steps.values():
        sender.outline(step)
    kinds = [key.split("-")[0] for key in ZarrStore(tmp_path)]
    # the settings, the cores and the large array; one recording for each part
    assert {kind: kinds.count(kind) for kind in kinds} == {"input": 3, "plan": 1, "recording": 5}


def test_what_was_sent_and_is_gone_is_sent_again(tmp_path):
    store, work = ZarrStore(tmp_path), parts(1)
    sender = Sender(work, store)
    step = next(iter(work.steps.values()))
    (key,) = filter(sending.is_recording, sending.receive(sender.outline(step), step.key, work_on).needs)
    del store[key]
    sender.forget(key)
    sender.outline(step)
    assert key in ZarrStore(tmp_path)


def test_a_process_keeps_one_recording_and_only_the_last_arguments(tmp_path, monkeypatch):
    monkeypatch.setattr(task, "_kept", {})
    work = parts(3)
    sender = Sender(work, ZarrStore(tmp_path))
    config, frames = [], []
    for number in range(3):
        step = next(s for s in work.steps.values() if s.name == f"solve-{number}")
        received = sending.receive(sender.outline(step), step.key, step.function)
        for _ in range(2):  # the second time it is there already
            store = ZarrStore(tmp_path)
            task._recall(received, store)
            task._keep(received, store)
            frames.append(weakref.ref(store[received.args[0].key]))
            config.append(store[received.args[2].key])
        del store
    gc.collect()
    assert [frame() is None for frame in frames] == [True] * 4 + [False] * 2
    assert frames[-1]() is frames[-2]()
    assert all(each is config[0] for each in config)
    last = sending.receive(sender.outline(list(work.steps.values())[-1]), "merge", work_on)
    store = ZarrStore(tmp_path)
    task._recall(last, store)
    # a step without a recording leaves the last one, for the step after it
    assert [key.split("-")[0] for key in task._kept] == ["recording"]


def test_equal_content_is_one_artifact(tmp_path):
    work, frame = Plan("1"), recording("same")
    for name, given in (("a", frame), ("b", replace(frame, root="/data"))):
        work.add(name, work_on, given)
    sender = Sender(work, ZarrStore(tmp_path))
    outlines = [sender.outline(step) for step in work.steps.values()]
    refs = [sending.receive(outline, "k", work_on).args[0] for outline in outlines]
    assert refs[0] == refs[1]
    assert isinstance(refs[0], Ref)

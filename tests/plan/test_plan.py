"""Plans: order, keys, resume."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lvba import plan
from lvba.plan import Plan, identity


@dataclass(frozen=True)
class Recording:
    root: str
    digest: str = ""


@dataclass(frozen=True)
class Sum:
    values: np.ndarray
    label: str = ""


def count(start, progress=None):
    return Sum(np.arange(4.0) + start)


def double(summed, factor=2.0):
    return replace(summed, values=summed.values * factor)


def total(parts, extra):
    return float(sum(part.values.sum() for part in parts)) + extra["more"]


def small_plan(factor=2.0, version="1"):
    work = Plan(version)
    first = work.add("count", count, 1)
    second = work.add("double", double, first, factor=factor)
    work.add("total", total, [first, second], {"more": 0.5})
    return work


def keys(work):
    return {step.name: step.key for step in work.steps.values()}


def test_runs_steps_in_order_over_a_dict():
    work = small_plan()
    store = plan.run(work, {})
    assert store[keys(work)["total"]] == 10 + 20 + 0.5


def test_step_names_its_inputs_also_in_lists():
    work = small_plan()
    key = keys(work)
    assert work.steps[key["total"]].needs == [key["count"], key["double"]]


def test_finished_step_is_not_done_again():
    work = small_plan()
    store = {keys(work)["count"]: Sum(np.full(4, 100.0))}
    assert plan.run(work, store)[keys(work)["total"]] == 400 + 800 + 0.5


def test_key_changes_with_a_constant_and_only_from_there_on():
    one, other = keys(small_plan()), keys(small_plan(factor=3.0))
    assert one["count"] == other["count"]
    assert one["double"] != other["double"]
    assert one["total"] != other["total"]


def test_key_changes_with_version_of_code_and_of_stage():
    assert keys(small_plan())["count"] != keys(small_plan(version="2"))["count"]
    work, again = Plan(), Plan()
    assert work.add("a", count, 1) != again.add("a", count, 1, version=2)


def test_keys_are_the_same_in_every_process():
    # a literal, so that a key that depends on the interpreter or on hash seeds is noticed
    assert plan.digest(plan.identity({"b": [1, 2.5, None, True], "a": np.arange(3, dtype=np.int32)})) == (
        "2424f3797468218380cfa06e6b5dc0461bd6afb5da930d4bed686cad5198eb9a"
    )


def test_long_tuple_counts_by_its_content_and_is_looked_at_once(monkeypatch):
    looks = []
    monkeypatch.setattr(plan, "identity", lambda value: looks.append(value) or identity(value))

    def two(value):
        work = Plan()
        return [work.add(name, double, value).key for name in ("a", "b")]

    long = tuple(range(100))
    found = two(long)
    assert looks.count(long) == 1
    assert two((*range(50), *range(50, 100))) == found
    assert not set(two(tuple(range(1, 101)))) & set(found)


def test_dataset_counts_by_its_digest_wherever_it_lies():
    assert plan.identity(Recording("/a", "d1")) == plan.identity(Recording("/b", "d1"))
    assert plan.identity(Recording("/a", "d1")) != plan.identity(Recording("/a", "d2"))
    assert plan.identity(Recording("/a")) != plan.identity(Recording("/b"))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.zeros(3), np.zeros((3, 1))),
        (np.zeros(2, np.float32), np.zeros(1, np.float64)),
        (Sum(np.zeros(3), "a"), Sum(np.zeros(3), "b")),
        (1, 2),
        ("1", 1),
        ([1, [2]], [1, 2]),
    ],
)
def test_unequal_values_have_unequal_identities(one, other):
    assert plan.digest(plan.identity(one)) != plan.digest(plan.identity(other))


def test_what_cannot_be_keyed_is_refused():
    with pytest.raises(TypeError, match="keyed by a object"):
        Plan().add("a", count, object())


def test_name_taken_and_unknown_input_are_refused():
    work = Plan()
    work.add("a", count, 1)
    with pytest.raises(ValueError, match="two steps"):
        work.add("a", count, 2)
    with pytest.raises(ValueError, match="no earlier step"):
        work.add("b", double, plan.Ref("elsewhere"))


def test_progress_reaches_functions_that_ask_for_it():
    told = []
    work = Plan()

    def slow(progress):
        progress("slow", 1, 2)
        return 1

    work.add("slow", slow)
    plan.run(work, {}, lambda *args: told.append(args))
    assert told == [("slow", 1, 2)]


def test_artifacts_have_the_memory_layout_they_would_have_from_a_store():
    work = Plan()
    ref = work.add("turned", lambda: {"a": [Sum(np.arange(12.0).reshape(3, 4).T)], "b": np.array(1.0, ">f8")})
    made = plan.run(work, {})[ref.key]
    assert made["a"][0].values.flags.c_contiguous
    assert made["a"][0].values.shape == (4, 3)
    assert made["b"].dtype.isnative
    assert made["b"].shape == ()


class Counting(dict):
    """A store that notes what is read."""

    def __init__(self):
        super().__init__()
        self.reads = []

    def __getitem__(self, key):
        self.reads.append(key)
        return super().__getitem__(key)


def look(read, wanted):
    return read().values.sum() if wanted else -1.0


@pytest.mark.parametrize("wanted", [True, False])
def test_what_is_asked_for_late_is_read_only_then(wanted):
    work, store = Plan("1"), Counting()
    first = work.add("count", count, 1)
    looked = work.add("look", look, plan.LazyRef(first.key), wanted)
    plan.run(work, store)
    assert store.reads == ([first.key] if wanted else [])
    assert store[looked.key] == (10.0 if wanted else -1.0)
    assert work.steps[looked.key].needs == [first.key]
    assert work.steps[looked.key].needs_at_once == []


class Holding(Counting):
    """A store that has its artifacts in memory too, from their reading on."""

    def __init__(self):
        super().__init__()
        self.memory = set()

    def __getitem__(self, key):
        self.memory.add(key)
        return super().__getitem__(key)

    def held(self):
        return list(self.memory)

    def release(self, key):
        self.memory.discard(key)


@pytest.mark.parametrize(("kind", "before", "after"), [
    (plan.LazyRef, False, True), (plan.StreamedRef, False, False), (plan.StreamedRef, True, True),
])  # fmt: skip
def test_what_passes_is_not_held_unless_it_was(kind, before, after):
    work, store = Plan("1"), Holding()
    first = work.add("count", count, 1)
    looked = work.add("look", look, kind(first.key), True)
    store[first.key] = plan.compute(work.steps[first.key], store)
    if before:
        store[first.key]
    assert plan.compute(work.steps[looked.key], store) == 10.0
    assert (first.key in store.held()) is after


def test_late_artifact_that_is_gone_is_named():
    work, store = Plan("1"), {}
    first = work.add("count", count, 1)
    work.add("look", look, plan.LazyRef(first.key), True)
    with pytest.raises(plan.MissingError) as gone:
        plan.compute(list(work.steps.values())[1], store)
    assert gone.value.key == first.key

"""Which steps can begin: against the plain rule, whatever happens in whatever order."""

import random

import pytest

from lvba.plan import Plan, Ref
from workers.frontier import Frontier, heights


def nothing(*inputs):
    return None


def key_of(work, name):
    (found,) = (key for key, step in work.steps.items() if step.name == name)
    return found


def parts(count, rounds=3):
    """A plan like that of a recording in parts: chains side by side, merged, then rounds over all of them."""
    work = Plan()
    solved = []
    for part in range(count):
        begun = work.add(f"begin-{part}", nothing)
        solved.append(work.add(f"solve-{part}", nothing, begun))
    state = work.add("merge", nothing, solved)
    for turn in range(rounds):
        shares = [work.add(f"share-{turn}-{part}", nothing, solved[part], state) for part in range(count)]
        state = work.add(f"step-{turn}", nothing, state, shares)
    return work


def ready(work, made, taken):
    """The plain rule: not made, not given away, and all it needs is made."""
    return {
        key
        for key, step in work.steps.items()
        if key not in made and key not in taken and made.issuperset(step.needs)
    }


def take_all(frontier):
    return list(iter(frontier.take, None))


@pytest.mark.parametrize("seed", range(20))
def test_what_can_begin_is_what_the_plain_rule_says(seed):
    chance = random.Random(seed)
    work = parts(4)
    frontier, made, taken = Frontier(work), set(), set()
    for _ in range(400):
        given = take_all(frontier)
        assert set(given) == ready(work, made, taken)
        taken.update(given)
        if not taken:
            break
        key = chance.choice(sorted(taken))
        taken.remove(key)
        what = chance.random()
        if what < 0.75:
            made.add(key)
            frontier.made(key)
        elif what < 0.85 or not work.steps[key].needs:
            frontier.again(key)
        else:
            gone = chance.sample(work.steps[key].needs, 1)
            made.difference_update(gone)
            frontier.lost(gone)
            frontier.again(key)
    assert made == set(work.steps)


def test_every_step_is_given_once_in_an_order_that_can_run():
    work = parts(30)
    frontier, order = Frontier(work), []
    while (key := frontier.take()) is not None:
        order.append(key)
        frontier.made(key)
    assert sorted(order) == sorted(work.steps)
    place = {key: number for number, key in enumerate(order)}
    assert all(place[needed] < place[key] for key in order for needed in work.steps[key].needs)


def test_a_part_is_finished_before_the_next_one_is_begun():
    work = parts(3)
    frontier, order = Frontier(work), []
    while (key := frontier.take()) is not None:
        order.append(work.steps[key].name)
        frontier.made(key)
    assert order[:7] == ["begin-0", "solve-0", "begin-1", "solve-1", "begin-2", "solve-2", "merge"]


def test_priority_grows_towards_the_end():
    work = parts(2)
    frontier = Frontier(work)
    order = ["begin-0", "solve-1", "merge", "share-0-1", "step-0", "share-2-0", "step-2"]
    levels = [frontier.priority(key_of(work, name)) for name in order]
    assert levels == sorted(set(levels))


def test_work_is_that_of_the_changes_and_not_of_the_plan(monkeypatch):
    looked = []
    offer = Frontier._offer
    monkeypatch.setattr(Frontier, "_offer", lambda self, key: (looked.append(key), offer(self, key))[1])
    work = parts(500)
    frontier = Frontier(work)
    while (key := frontier.take()) is not None:
        frontier.made(key)
    edges = sum(len(step.needs) for step in work.steps.values())
    assert len(looked) == len(work.steps) + edges


def test_heights():
    assert heights({"a": [], "b": ["a"], "c": ["a", "b"], "d": []}) == {"a": 2, "b": 1, "c": 0, "d": 0}


def test_refs_that_are_needed_twice_count_once():
    work = Plan()
    a = work.add("a", nothing)
    work.add("b", nothing, a, [a, Ref(a.key)])
    frontier = Frontier(work)
    assert take_all(frontier) == [a.key]
    frontier.made(a.key)
    assert len(take_all(frontier)) == 1

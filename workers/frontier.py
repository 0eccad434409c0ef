"""Which steps of a plan can begin: an index that is told what happens, and never looks at the whole plan again."""

import heapq
from collections.abc import Iterable

from lvba.plan import Plan


class Frontier:
    """The steps that can begin, nearest to the end of the plan first: parts are finished before others are begun."""

    def __init__(self, work: Plan) -> None:
        self._needs = {key: step.needs for key, step in work.steps.items()}
        self._users = _users(self._needs)
        self._rank = {
            key: (height, number) for number, (key, height) in enumerate(heights(self._needs).items())
        }
        self._waits = {key: set(needs) for key, needs in self._needs.items()}
        self._made: set[str] = set()
        self._taken: set[str] = set()
        self._queued: set[str] = set()
        self._heap: list[tuple[tuple[int, int], str]] = []
        for key in self._needs:
            self._offer(key)

    def take(self) -> str | None:
        """A step whose inputs are all there, which is not given again before `made`, `again` or `lost`; None: no such."""
        while self._heap:
            key = heapq.heappop(self._heap)[1]
            self._queued.discard(key)
            if not self._waits[key]:  # an input may have been lost since
                self._taken.add(key)
                return key
        return None

    def made(self, key: str) -> None:
        """The step's artifact is there."""
        self._taken.discard(key)
        self._made.add(key)
        for user in self._users[key]:
            self._waits[user].discard(key)
            self._offer(user)

    def again(self, key: str) -> None:
        """A step that was taken was not made, and is to begin again."""
        self._taken.discard(key)
        self._offer(key)

    def lost(self, keys: Iterable[str]) -> None:
        """Artifacts that were made are gone: they are made again, before all that needs them and is not made yet."""
        for key in keys:
            self._made.discard(key)
            for user in self._users[key]:
                self._waits[user].add(key)
            self._offer(key)

    def priority(self, key: str) -> int:
        """Larger for a step nearer to the end."""
        return -self._rank[key][0]

    def _offer(self, key: str) -> None:
        busy = key in self._made or key in self._taken or key in self._queued
        if not busy and not self._waits[key]:
            self._queued.add(key)
            heapq.heappush(self._heap, (self._rank[key], key))


def heights(needs: dict[str, list[str]]) -> dict[str, int]:
    """For each step how many others follow it at least one after another; needs: of each, in an order that can run."""
    heights_by_key = dict.fromkeys(needs, 0)
    for key in reversed(needs):
        for needed in needs[key]:
            heights_by_key[needed] = max(heights_by_key[needed], heights_by_key[key] + 1)
    return heights_by_key


def _users(needs: dict[str, list[str]]) -> dict[str, list[str]]:
    users: dict[str, list[str]] = {key: [] for key in needs}
    for key, all_needed in needs.items():
        for needed in dict.fromkeys(all_needed):
            users[needed].append(key)
    return users

"""What a run tells, line by line, as the stages, progress and time left that people see. No clock, no database."""

from collections.abc import Mapping
from typing import Any

from service.db.journal import PROGRESS, STAGE, STAGES
from service.jobs.run_events import IMPORT, EndReason, RunEnd, run_end

JobEvent = tuple[str, dict[str, Any]]
"""Kind and data of an event for the journal."""

_AFTER_IMPORT = 9.0
"""Work after an import, of its own, where no run was finished here."""
WAITING, RUNNING, DONE, FAILED, STOPPED = "waiting", "running", "done", "failed", "stopped"


class Timeline:
    """The stages of one attempt.

    weights: of stages by name, about their fractions of the time in finished runs; of others, the mean of these
    estimate_s: of the whole run, before it begins
    """

    def __init__(self, weights: Mapping[str, float], estimate_s: float, now: float) -> None:
        self.stages: list[dict[str, Any]] = []
        self.end: RunEnd | None = None
        """The last line of the run; None: it has not come."""
        self._weights, self._estimate_s, self._began = weights, estimate_s, now
        self._other = sum(weights.values()) / len(weights) if weights else 1.0
        self._stage_began = self._count_began = now
        self._fraction = 0.0
        self._all_named = True

    def take(self, line: Mapping[str, Any], now: float) -> list[JobEvent]:
        """Add what a line of the run says; the events that it makes."""
        kind = line.get("event")
        if kind == "stages":
            return self._list(line, now)
        if kind == "stage" and self.stages:
            return self._begin(str(line["name"]), line.get("reused"), now)
        if kind == "progress" and self.stages:
            return self._count(line, now)
        if kind == "record":
            self._record(line)
        if kind == "end":
            return self._finish(line, now)
        return []

    def _list(self, line: Mapping[str, Any], now: float) -> list[JobEvent]:
        """The names of all stages, or of the first ones (`run_events.IMPORT`), which then have gone their way."""
        records = self._end_running(DONE, now)
        self._all_named = line["names"][0] != IMPORT or bool(self.stages)
        known = {stage["name"]: stage for stage in self.stages}
        self.stages = [known.get(str(name)) or _waiting(str(name)) for name in line["names"]]
        if not known and line["names"][0] != IMPORT:
            self.stages[0]["state"] = DONE
        return [*records, (STAGES, {"stages": [stage["name"] for stage in self.stages]})]

    def give_up(self, now: float) -> None:
        """The stage that runs has failed, and nobody is there any more to say so."""
        self._end_running(FAILED, now)

    def stop(self, now: float) -> None:
        """Somebody ended the run: the stage that it was at has not failed."""
        self._end_running(STOPPED, now)
        for stage in self.stages:
            if stage["state"] == FAILED:
                stage["state"] = STOPPED

    def fraction(self) -> float:
        """How much of the work is done, 0..1; never less than before."""
        done = sum(self._weight(stage) * _part(stage) for stage in self.stages)
        every = self._every()
        self._fraction = max(self._fraction, done / every if every else 0.0)
        return self._fraction

    def eta_s(self, now: float) -> float | None:
        """Seconds left, about; None where no run was finished here: nothing tells then how long stages take.

        The estimate counts for as much as the part of the work that is left, the pace so far for the rest: at first
        nearly all is known from earlier runs, in the end nearly all from this one, and it does not jump between them.
        """
        if not self._weights or not self._estimate_s:
            return None
        elapsed = now - self._began
        every, unknown = self._every(), self._unknown()
        made = [stage for stage in self.stages if not stage["reused"]]
        fraction = (sum(self._weight(stage) for stage in made) + unknown) / every if every else 1.0
        if not fraction or not made:
            return round(max(self._estimate_s - elapsed, 0.0), 1)
        left = sum(self._weight(stage) * (1.0 - self._done(stage, every, now)) for stage in made)
        left = (left + unknown) / every
        part = left / fraction
        # the pace so far makes elapsed / (1 - part) of the whole; weighed by 1 - part
        return round(part * (part * fraction * self._estimate_s + elapsed), 1)

    def _every(self) -> float:
        """The weights of all stages."""
        return sum(self._weight(stage) for stage in self.stages) + self._unknown()

    def _unknown(self) -> float:
        """The weights of the stages that are not named yet, about: by finished runs, or else most of all."""
        if self._all_named:
            return 0.0
        known = sum(self._weight(stage) for stage in self.stages)
        others = sum(weight for name, weight in self._weights.items() if name not in (IMPORT, "input"))
        return others if self._weights else _AFTER_IMPORT * known

    def _done(self, stage: Mapping[str, Any], every: float, now: float) -> float:
        """The part of a stage that is done, 0..1, by its count or by the time that it should take."""
        expected = self._estimate_s * self._weight(stage) / every
        if stage["state"] != RUNNING or not expected:
            return _part(stage)
        return max(_part(stage), min((now - self._stage_began) / expected, 0.9))

    def current(self) -> str | None:
        """The stage that runs."""
        return next((stage["name"] for stage in self.stages if stage["state"] == RUNNING), None)

    def _weight(self, stage: Mapping[str, Any]) -> float:
        return self._weights.get(stage["name"], self._other)

    def _begin(self, name: str, reused: bool | None, now: float) -> list[JobEvent]:
        records = self._end_running(DONE, now)
        for stage in self.stages:
            if stage["name"] == name:
                stage["state"], stage["reused"] = RUNNING, reused
                self._stage_began = self._count_began = now
                records.append(self._shown(stage))
        return records

    def _end_running(self, state: str, now: float) -> list[JobEvent]:
        records = []
        for stage in self.stages:
            if stage["state"] == RUNNING:
                stage["state"], stage["eta_s"] = state, None
                if state == DONE:
                    stage["done"] = stage["total"]
                if not stage["reused"]:
                    stage["seconds"] = round(now - self._stage_began, 3)
                records.append(self._shown(stage))
        return records

    def _shown(self, stage: Mapping[str, Any]) -> JobEvent:
        facts = {name: stage[name] for name in ("name", "state", "reused", "seconds", "peak_memory_mb")}
        return STAGE, {"index": self.stages.index(dict(stage)), "total": len(self.stages), **facts}

    def _count(self, line: Mapping[str, Any], now: float) -> list[JobEvent]:
        for stage in self.stages:
            if stage["name"] == line["stage"]:
                if stage["what"] != line["what"]:
                    self._count_began = now
                stage.update(what=line["what"], done=line["done"], total=line["total"])
                stage["eta_s"] = _left(line["done"], line["total"], now - self._count_began)
                said = {"stage": stage["name"], **{name: line[name] for name in ("what", "done", "total")}}
                said |= {"fraction": round(self.fraction(), 4), "eta_s": self.eta_s(now)}
                return [(PROGRESS, said)]
        return []

    def _record(self, line: Mapping[str, Any]) -> None:
        for stage in self.stages:
            if stage["name"] == line["name"]:
                stage.update({name: line[name] for name in ("seconds", "peak_memory_mb", "reused")})

    def _finish(self, line: Mapping[str, Any], now: float) -> list[JobEvent]:
        self.end = run_end(line)
        states = {EndReason.DONE: DONE, EndReason.STOPPED: STOPPED}
        records = self._end_running(states.get(self.end.reason, FAILED), now)
        if self.end.reason is EndReason.DONE:
            self._fraction = 1.0
        return records


def _waiting(name: str) -> dict[str, Any]:
    empty = dict.fromkeys(("what", "done", "total", "seconds", "eta_s", "peak_memory_mb", "reused"))
    return {"name": name, "state": WAITING, **empty}


def _part(stage: Mapping[str, Any]) -> float:
    if stage["state"] == DONE:
        return 1.0
    if stage["state"] != RUNNING or not stage["total"]:
        return 0.0
    # counts follow one another within a stage: the last of them is all that is known
    return min(float(stage["done"]) / float(stage["total"]), 1.0) * 0.9


def _left(done: int, total: int, seconds: float) -> float | None:
    return round(seconds * (total - done) / done, 1) if done and total > done else None


def time_fractions(history: list[list[dict[str, Any]]]) -> dict[str, float]:
    """Mean fraction of the time of each stage, by name, in the runs that were finished."""
    fractions: dict[str, list[float]] = {}
    for stages in history:
        total = sum(stage["seconds"] or 0.0 for stage in stages)
        for stage in stages if total else []:
            fractions.setdefault(stage["name"], []).append((stage["seconds"] or 0.0) / total)
    return {name: sum(parts) / len(parts) for name, parts in fractions.items()}

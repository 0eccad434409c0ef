"""A question about a source that its data answer: scores of the answers, margin, and what is taken."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lvba.errors import InputError

SIGMAS = 3.0
"""Standard errors by which an answer must be better than another to be taken over it."""
_LEAST_GAIN = 0.02
"""Part of the score by which it must be better: what is less may be an error that all pairs share."""
_LEAST = 1e-6
_FEWEST = 4
"""Pairs, for a standard error."""


@dataclass(frozen=True)
class Answer:
    """One answer to a question. scores: (P,) float64, of each pair, smaller is better."""

    name: str
    scores: np.ndarray

    @property
    def score(self) -> float:
        """The geometric mean over pairs."""
        return mean(self.scores)


@dataclass(frozen=True)
class Decision:
    """What is taken, and why. by: "data", "option", "default" (data cannot tell), "only" (there is one answer),
    or what else says it where data leave it open.

    unit: of the scores; best: the answer with the best score; margin, error: the logarithm of
    by how much the next best is worse, and the standard error of that; open: answers that data cannot tell from the best
    """

    question: str
    taken: str
    by: str
    unit: str
    scores: tuple[tuple[str, float], ...]
    best: str
    margin: float
    error: float
    open: tuple[str, ...]
    warning: str = ""

    def by_scores(self) -> "Decision":
        """With the answer of the best score."""
        return replace(self, taken=self.best, by=self.by if self.taken == self.best else "data")

    def against(self, guessed: str, known_by: str) -> str:
        """A warning where data speak against what `known_by` says; "" where they do not, or an option decides."""
        if not known_by or self.by == "option" or self.taken == guessed:
            return ""
        return f"{self.question}: {known_by} says {guessed}, the data say {self.taken}: applied"

    def measured(self, name: str, score: float, warning: str) -> "Decision":
        """With an answer that no convention gives. score: as of the others"""
        table = (*self.scores, (name, score))
        return replace(self, taken=name, by="data", scores=table, best=name, warning=warning)

    def facts(self) -> dict[str, Any]:
        """For recording.yaml."""
        result: dict[str, Any] = {"taken": self.taken, "by": self.by}
        if len(self.scores) > 1:
            result["scores"] = {name: float(f"{score:.4g}") for name, score in self.scores}
            result["unit"] = self.unit
            result["margin"] = float(f"{self.margin:.3g}")
            result["margin_error"] = float(f"{self.error:.2g}")
        if self.warning:
            result["warning"] = self.warning
        return result


def mean(scores: np.ndarray) -> float:
    """The geometric mean of scores (P,) float64 of pairs: where some pairs tell much and others little, all count."""
    return float(np.exp(np.mean(np.log(np.maximum(scores, _LEAST)))))


def better(one: Answer, other: Answer) -> bool:
    """Whether `one` is better beyond chance."""
    margin, error = _margin(one, other)
    return len(one.scores) >= _FEWEST and margin > max(SIGMAS * error, _LEAST_GAIN)


def decide(
    question: str,
    answers: list[Answer],
    said: str,
    preferred: str,
    unit: str,
    where: object,
    excluded: Collection[str] = (),
    known_by: str = "",
) -> Decision:
    """What is taken of answers.

    said: by an option, ""; preferred: what is taken where data leave it open and it is among what they leave open
    excluded: answers that something else than scores speaks against
    known_by: what says `preferred`, beside the data: then no warning is needed where they leave it open
    Raises InputError: data clearly contradict what is said.
    """
    order = sorted(answers, key=lambda answer: answer.score)
    best = order[0]
    left = tuple(
        answer.name for answer in answers if not (answer.name in excluded or better(best, answer))
    ) or (best.name,)
    margin, error = _margin(best, order[1]) if len(order) > 1 else (0.0, 0.0)
    table = tuple((answer.name, answer.score) for answer in answers)
    taken, by, warning = left[0], "data" if len(answers) > 1 else "only", ""
    if said:
        taken, by = said, "option"
        if said not in left:
            against = next(answer for answer in answers if answer.name == said)
            raise InputError(
                where,
                f"--convention {question}={said} contradicts the data: {_shown(against, unit)} against "
                f"{_shown(best, unit)} as {best.name}",
                f"leave it to the data, or give {question}={best.name}",
            )
    elif len(left) > 1:
        taken, by = (preferred if preferred in left else best.name), "default"
        by = known_by if known_by and taken == preferred else by
        warning = (
            ""
            if by == known_by
            else (
                f"{question}: the data cannot tell {' from '.join(left)} "
                f"({', '.join(_shown(answer, unit) for answer in answers if answer.name in left)}): {taken} is taken; "
                f"--convention {question}=... decides"
            )
        )
    return Decision(
        question=question,
        taken=taken,
        by=by,
        unit=unit,
        scores=table,
        best=best.name,
        margin=margin,
        error=error,
        open=left,
        warning=warning,
    )


def _margin(one: Answer, other: Answer) -> tuple[float, float]:
    """By how much `other` is worse, as a part, and the standard error."""
    difference = np.log(np.maximum(other.scores, _LEAST)) - np.log(np.maximum(one.scores, _LEAST))
    count = len(difference)
    error = float(difference.std(ddof=1) / np.sqrt(count)) if count > 1 else float("inf")
    return float(difference.mean()), error


def _shown(answer: Answer, unit: str) -> str:
    return f"{100 * answer.score:.2f} cm" if unit == "m" else f"{answer.score:.3f}"

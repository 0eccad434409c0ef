"""Settings of a run: what each means is said once, beside its default, in the dataclass that holds it.

The range check, the comments of config.yaml, the settings reference and the schema of a server are made from that.
"""

import dataclasses
import inspect
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_KEY = "lvba.setting"


class RangeError(ValueError):
    """A value that a setting cannot have. name: of the field in its group."""

    def __init__(self, name: str, message: str) -> None:
        self.name = name
        super().__init__(message)


@dataclass(frozen=True)
class About:
    """What a user is told of one setting.

    meaning: one or more sentences; unit: as in "m", empty: none; change_when: a sentence
    low, high: the range, ends included; None: open. also: values outside of it that are allowed
    odd: whole and odd numbers only
    advanced: nobody needs it for a first result
    """

    meaning: str
    unit: str
    low: float | None
    high: float | None
    also: tuple[Any, ...]
    odd: bool
    choices: tuple[Any, ...]
    change_when: str
    advanced: bool

    @property
    def text(self) -> str:
        """Meaning, range and when to change it, as one text."""
        allowed = " ".join(part for part in (self.allowed, self.unit) if part)
        advice = self.change_when and f"Change it when: {self.change_when}"
        return " ".join(part for part in (self.meaning, allowed and f"{allowed}.", advice) if part)

    @property
    def allowed(self) -> str:
        """The range in words; empty where the type says all."""
        if self.choices:
            return ", ".join(str(choice) for choice in self.choices)
        kind = "odd, " if self.odd else ""
        if self.low is not None and self.high is not None:
            words = f"{kind}{self.low:.15g} to {self.high:.15g}"
        elif self.low is not None:
            words = f"{kind}at least {self.low:.15g}"
        elif self.high is not None:
            words = f"{kind}at most {self.high:.15g}"
        else:
            return ""
        return " or ".join([*(f"{value:g}" for value in self.also), words])


@dataclass(frozen=True)
class Setting:
    """One setting in its place. name: dotted, as in `visual.levels`; hint: its annotation; default: in that place."""

    name: str
    hint: Any
    default: Any
    about: About

    @property
    def type_words(self) -> str:
        """Its type in a few words."""
        return _type_words(self.hint)


def setting(
    default: Any,
    *,
    meaning: str,
    change_when: str,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    also: tuple[Any, ...] = (),
    odd: bool = False,
    choices: tuple[Any, ...] = (),
    advanced: bool = False,
) -> Any:
    """A dataclass field with its description; see `About`.

    The metadata also has the names under which pydantic looks for a description and limits: a service that is given the
    dataclass describes it with these.
    """
    about = About(
        meaning=meaning,
        unit=unit,
        low=low,
        high=high,
        also=also,
        odd=odd,
        choices=choices,
        change_when=change_when,
        advanced=advanced,
    )
    metadata = {_KEY: about, **_for_pydantic(about)}
    if isinstance(default, dict):
        return dataclasses.field(default_factory=default.copy, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def _for_pydantic(about: About) -> dict[str, Any]:
    limits = {} if about.also else {"ge": about.low, "le": about.high}
    more = {
        "level": "advanced" if about.advanced else "basic",
        "unit": about.unit,
        "meaning": about.meaning,
        "range": "" if about.choices else about.allowed,
        "change_when": about.change_when,
    }
    given = {name: value for name, value in limits.items() if value is not None}
    return {
        "description": about.text,
        "json_schema_extra": {name: text for name, text in more.items() if text},
        **given,
    }


def about(field: "dataclasses.Field[Any]") -> About | None:
    """The description of a dataclass field; None: it is no setting, but a group of them."""
    known = field.metadata.get(_KEY)
    return known if isinstance(known, About) else None


def check(config: Any) -> None:
    """Raises RangeError: a setting of this group that is out of its range or none of its choices."""
    for field in dataclasses.fields(config):
        known = about(field)
        if known is None:
            continue
        value = getattr(config, field.name)
        if value in known.also or _is_allowed(value, known):
            continue
        allowed = f"one of {known.allowed}" if known.choices else known.allowed
        unit = f" {known.unit}" if known.unit else ""
        raise RangeError(field.name, f"{field.name} is {value!r}, must be {allowed}{unit}")


class Group:
    """What the dataclass of a group of settings is derived from: none is made with a value out of its range."""

    def __post_init__(self) -> None:
        """Raises RangeError as `check` does."""
        check(self)


def _is_allowed(value: Any, known: About) -> bool:
    if known.choices:
        return value in known.choices
    if known.low is not None and not value >= known.low:
        return False
    if known.high is not None and not value <= known.high:
        return False
    return not known.odd or value % 2 == 1


def every(kind: Any, prefix: str = "", config: Any = None) -> Iterator[Setting]:
    """All settings of a dataclass and of the groups in it, in the order of declaration.

    config: an instance, whose values then are the defaults; None: one without arguments
    """
    config = kind() if config is None else config
    hints = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        name, hint, value = prefix + field.name, hints[field.name], getattr(config, field.name)
        known = about(field)
        if dataclasses.is_dataclass(hint):
            yield from every(hint, f"{name}.", value)
        elif known is not None:
            yield Setting(name, hint, value, known)


def summary(kind: Any) -> str:
    """What a group is about: the first paragraph of its docstring."""
    return (inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " ")


_TYPES = {int: "whole number", float: "number", bool: "true or false", str: "text", type(None): "none"}


def _type_words(hint: Any) -> str:
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "choice"
    if origin in (Union, types.UnionType):
        return " or ".join(_type_words(one) for one in inner)
    if origin in (tuple, list):
        return f"list, each a {_type_words(inner[0])}"
    return _TYPES.get(hint, str(hint))


def check_ranges(config: Any, group: str, **ranges: tuple[float, float]) -> None:
    """Of a group of constants of the method, which are no settings: raises ValueError where one is out of its range.

    ranges: by the names of fields, lowest and highest value allowed
    """
    for name, (low, high) in ranges.items():
        if not low <= getattr(config, name) <= high:
            raise ValueError(f"{group}.{name} = {getattr(config, name)}; allowed: {low} to {high}")

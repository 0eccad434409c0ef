"""Settings: nested frozen dataclasses from dicts, YAML text and `name=value` options, and back.

Every mistake is one InputError that names the setting and, for a misspelt name, the one that was probably meant.
"""

import dataclasses
import difflib
import logging
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from lvba import retired_settings, settings
from lvba.errors import InputError
from lvba.io import plain_yaml
from lvba.settings import RangeError
from lvba.wording import first_of

Config = TypeVar("Config")
_log = logging.getLogger(__name__)
_MOST = 1 << 63
_NAMED = 3
"""Ignored settings that a warning names."""
_DEEPEST = 16
"""Levels of names in names that no setting has."""


class SettingError(InputError):
    """A setting that does not exist, or a value that it cannot have.

    setting: its dotted name, or that of its group, such as visual.levels
    """

    def __init__(self, where: str, path: str, problem: str, mend: str, name: str = "") -> None:
        """path: as the message has it; name: of the setting in the group at path, if it is known."""
        self.setting = f"{path}{name}".partition("[")[0].rstrip(".")
        self._made_from = (where, path, problem, mend, name)
        super().__init__(_at(where, path), problem, mend)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._made_from


def load(kind: type[Config], text: str, overrides: Sequence[str] = (), where: str = "config") -> Config:
    """A config from YAML text (may be empty) and options such as `visual.levels=3`, which win over the text.

    where: names the text in errors, such as the file's path
    """
    values = parse(text, where)
    base = from_mapping(kind, values, where)
    return override(base, overrides) if overrides else base


def parse(text: str, where: str = "config") -> dict[str, Any]:
    """The mapping that YAML text holds.

    Raises InputError: not YAML, not a mapping, or a name is there twice.
    """
    values = plain_yaml.load(text, where, "write `name: value` lines, indented by spaces", unique=True)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise InputError(where, f"holds a {type(values).__name__}, not settings", "write `name: value` lines")
    return values


def override(config: Config, options: Sequence[str], where: str = "--set") -> Config:
    """The config with `name=value` options applied, in order; names are dotted, values are YAML.

    Raises InputError: an option is not of that form, or its value is out of range.
    """
    values: dict[str, Any] = {}
    for option in options:
        name, equals, text = option.partition("=")
        if not equals or not name.strip():
            raise InputError(f"{where} {option}", "not of the form name=value", "for example visual.levels=3")
        try:
            value = plain_yaml.load(text, where)
        except InputError:
            value = text
        _put(values, name.strip().split("."), value, f"{where} {option}")
    return from_mapping(type(config), values, where, base=config)


def from_mapping(
    kind: type[Config], values: Mapping[str, Any], where: str = "config", base: Config | None = None
) -> Config:
    """A config of this kind from nested mappings; what they do not name is as in `base`, or the default.

    Settings of an earlier version are passed over with a warning where they have the default that they had.

    Raises InputError: a name that is no setting, a value of another type or out of range.
    """
    if getattr(kind, "KNOWS_RETIRED", False) and isinstance(values, Mapping):
        _refuse_deep(values, where)
        values = retired_settings.with_new_names(_without_retired(values, where))
    built: Config = _build(kind, values, where, "", base)
    return built


def _refuse_deep(values: Mapping[str, Any], where: str) -> None:
    """Raises SettingError: values are nested deeper than any setting is, by thousands of dots in a name, say."""
    level: list[Mapping[str, Any]] = [values]
    for _ in range(_DEEPEST):
        level = [value for each in level for value in each.values() if isinstance(value, Mapping)]
        if not level:
            return
    raise SettingError(where, "settings", "nested too deep", "use names such as visual.levels")


def _without_retired(values: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    old = dict(retired_settings.retired(values))
    for name, value in old.items():
        if not retired_settings.is_default(name, value):
            problem = f"{_quoted(value)}: this setting was removed"
            raise SettingError(where, name, problem, retired_settings.mend(name))
    if old:
        _log_ignored(where, list(old))
    return retired_settings.without(values) if old else values


def _log_ignored(where: str, names: Sequence[str]) -> None:
    """One short warning; all names only where more than warnings is asked for."""
    shown = first_of(names, _NAMED)
    if len(names) <= _NAMED:
        _log.warning("%s: ignored, because they were removed: %s", where, shown)
        return
    _log.warning(
        "%s: %d settings of an earlier version are ignored: %s (--verbose names all)",
        where,
        len(names),
        shown,
    )
    _log.debug("%s: ignored settings: %s", where, ", ".join(names))


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dicts of every setting: what `from_mapping` takes, and what YAML and JSON can hold."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def to_yaml(config: Any) -> str:
    """Every setting as YAML text, in the order of declaration, with what each means as a comment."""
    return "\n".join(_yaml_lines(config, "")) + "\n"


def _yaml_lines(config: Any, indent: str) -> Iterator[str]:
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from _comment(settings.summary(type(value)), indent)
            yield f"{indent}{item.name}:"
            yield from _yaml_lines(value, indent + "  ")
            continue
        known = settings.about(item)
        if known is not None:
            unit = f" Unit: {known.unit}." if known.unit else ""
            allowed = f" Allowed: {known.allowed}." if known.allowed else ""
            yield from _comment(f"{known.meaning}{unit}{allowed}", indent)
        text = yaml.safe_dump({item.name: _plain(value)}, sort_keys=False, allow_unicode=True)
        yield from (indent + line for line in text.splitlines())


def _comment(text: str, indent: str) -> list[str]:
    mark = f"{indent}# "
    return textwrap.wrap(text, 100, initial_indent=mark, subsequent_indent=mark, break_on_hyphens=False)


def names(kind: Any, prefix: str = "") -> list[str]:
    """The dotted names of all settings, in the order of declaration."""
    dotted = []
    hints = get_type_hints(kind)
    for item in dataclasses.fields(kind):
        name, hint = prefix + item.name, hints[item.name]
        dotted += names(hint, f"{name}.") if dataclasses.is_dataclass(hint) else [name]
    return dotted


def _build(kind: Any, values: Any, where: str, path: str, base: Any) -> Any:
    if not isinstance(values, Mapping):
        example = f"{path.rstrip('.')}.{dataclasses.fields(kind)[0].name}"
        raise SettingError(
            where,
            path,
            f"{_quoted(values)} is a single value, but this is a group",
            f"set {example} or others in it",
        )
    hints = get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind) if f.init]
    for name in values:
        if name not in known:
            raise _unknown(kind, str(name), where, path, known)
    given = {}
    for name, value in values.items():
        given[name] = coerce(value, hints[name], where, f"{path}{name}", getattr(base, name, None))
    try:
        return dataclasses.replace(base, **given) if base is not None else kind(**given)
    except ValueError as error:
        name = error.name if isinstance(error, RangeError) else _culprit(kind, given, base)
        raise SettingError(where, path, str(error), "choose a value in the range given", name) from None


def _culprit(kind: Any, given: Mapping[str, Any], base: Any) -> str:
    """The first setting of a group that is refused also alone; empty: they are refused together only."""
    for name, value in given.items():
        try:
            dataclasses.replace(kind() if base is None else base, **{name: value})
        except ValueError:
            return name
    return ""


def coerce(value: Any, hint: Any, where: str, path: str, base: Any = None) -> Any:
    """The value as the type that a setting's annotation asks for; what a group does not name is as in `base`.

    Raises InputError: it cannot be read as that type.
    """
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where, f"{path}.", base)
    if _is_list_of_groups(hint) and isinstance(value, list | tuple):
        group = get_args(hint)[0]
        return get_origin(hint)(
            _build(group, item, where, f"{path}[{number}].", None) for number, item in enumerate(value)
        )
    try:
        return _coerce(value, hint)
    except (TypeError, ValueError, OverflowError):
        raise SettingError(
            where,
            path,
            f"{_quoted(value)} is not {_words(hint)}",
            "see docs/settings.md, or config.yaml of any result",
        ) from None


def _coerce(value: Any, hint: Any) -> Any:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _first_that_fits(value, inner)
    if origin is Literal:
        return _literal(value, inner)
    if origin in (tuple, list):
        return _coerce_sequence(value, origin, inner)
    if hint is type(None):
        return _require(value is None, None)
    if hint is bool:
        return _require(isinstance(value, bool), value)
    if hint is int:
        return _whole(value)
    if hint is float:
        # YAML reads 1e-6 as text
        return float(_require(isinstance(value, int | float | str) and not isinstance(value, bool), value))
    if hint is str:
        return str(_require(isinstance(value, str | int | float) and not isinstance(value, bool), value))
    return value


def _is_list_of_groups(hint: Any) -> bool:
    inner = get_args(hint)
    return get_origin(hint) in (tuple, list) and bool(inner) and dataclasses.is_dataclass(inner[0])


def _whole(value: Any) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return int(_require(abs(value) < _MOST, value))
    number = float(_require(isinstance(value, float | str), value))
    return int(_require(number.is_integer() and abs(number) < _MOST, number))


def _first_that_fits(value: Any, hints: tuple[Any, ...]) -> Any:
    # None is tried first: the text "None" or "null" means it wherever it is allowed
    for hint in sorted(hints, key=lambda h: h is not type(None)):
        try:
            return _coerce(None if value == "None" and hint is type(None) else value, hint)
        except (TypeError, ValueError, OverflowError):
            continue
    raise ValueError


def _literal(value: Any, choices: tuple[Any, ...]) -> Any:
    for choice in choices:
        if value == choice and isinstance(value, bool) == isinstance(choice, bool):
            return choice
    raise ValueError(value)


def _coerce_sequence(value: Any, origin: Any, inner: tuple[Any, ...]) -> Any:
    _require(isinstance(value, list | tuple), None)
    if not inner:
        return origin(value)
    hints = [inner[0]] * len(value) if origin is list or inner[-1] is Ellipsis else list(inner)
    _require(len(hints) == len(value), None)
    return origin(_coerce(item, hint) for item, hint in zip(value, hints, strict=True))


def _require(condition: bool, value: Any) -> Any:
    if not condition:
        raise TypeError
    return value


def _put(values: dict[str, Any], names: list[str], value: Any, where: str) -> None:
    for name in names[:-1]:
        values = values.setdefault(name, {})
        if not isinstance(values, dict):
            raise InputError(
                where, f"{name} was set to a single value before", "give one of the two options only"
            )
    values[names[-1]] = value


def _unknown(kind: Any, name: str, where: str, path: str, known: list[str]) -> SettingError:
    every = [path + other for other in names(kind)]
    if not path and (dotted := difflib.get_close_matches(name, every, 1) if "." in name else []):
        *groups, last = dotted[0].split(".")
        nested = "".join(f"{group}: {{" for group in groups) + f"{last}: ..." + "}" * len(groups)
        return SettingError(where, name, "is a group and a name in it", f"write them nested, {nested}")
    close = difflib.get_close_matches(name, known, 1) or [
        # right name in the wrong group, or a misspelling further down
        other.removeprefix(path)
        for other in difflib.get_close_matches(path + name, every, 1)
    ]
    mend = f"did you mean {path}{close[0]}?" if close else f"known here: {', '.join(known)}"
    return SettingError(where, path + name, "no such setting", mend)


def _at(where: str, path: str) -> str:
    path = path.rstrip(".")
    return f"{where}: {path}" if path else where


def _quoted(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python does not write out numbers of more than some thousand digits
        return "a number of very many digits"


def _words(hint: Any) -> str:
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(str(choice) for choice in inner)
    if origin in (Union, types.UnionType):
        return " or ".join(_words(h) for h in inner)
    if origin in (tuple, list):
        count = "" if origin is list or not inner or inner[-1] is Ellipsis else f"{len(inner)} "
        return f"a list of {count}values" + (f", each {_words(inner[0])}" if inner else "")
    plain = {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "a text",
        type(None): "null",
    }
    return plain.get(hint, f"a {getattr(hint, '__name__', hint)}")


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_dict(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value

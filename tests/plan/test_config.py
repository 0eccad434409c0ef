"""Settings from dicts, YAML and options: strict, typed, one line for each mistake."""

from dataclasses import dataclass, field
from typing import Literal

import pytest

from lvba import config
from lvba.errors import InputError
from lvba.run_settings import Config


@dataclass(frozen=True)
class Solver:
    iterations: int = 20
    tolerance: float = 1e-6
    kernel: Literal["huber", "none"] = "huber"

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}, must be 1 or more")


@dataclass(frozen=True)
class Settings:
    rounds: tuple[Solver, ...] = (Solver(), Solver(5))
    name: str = "a"
    levels: int | None = None
    enabled: bool = True
    voxel_sizes: tuple[float, ...] = (1.0, 0.5)
    pair: tuple[int, float] = (1, 2.0)
    solver: Solver = field(default_factory=Solver)


def test_empty_text_is_the_default():
    assert config.load(Settings, "") == Settings()


def test_yaml_options_and_order_of_precedence():
    text = "levels: 2\nsolver: {iterations: 5}\n"
    loaded = config.load(Settings, text, ["levels=3", "solver.tolerance=1e-3", "voxel_sizes=[2, 1]"])
    assert loaded == Settings(levels=3, voxel_sizes=(2.0, 1.0), solver=Solver(5, 1e-3))


def test_options_on_one_group_add_up():
    changed = config.override(Settings(), ["solver.iterations=7", "solver.kernel=none"])
    assert changed.solver == Solver(7, kernel="none")


def test_round_trip_through_yaml_holds_every_value():
    settings = Settings(levels=4, enabled=False, voxel_sizes=(0.25,), solver=Solver(tolerance=1e-9))
    assert config.load(Settings, config.to_yaml(settings)) == settings


def test_lists_of_groups():
    changed = config.override(Settings(), ["rounds=[{iterations: 3}, {tolerance: 1e-2, kernel: none}]"])
    assert changed.rounds == (Solver(3), Solver(tolerance=1e-2, kernel="none"))
    assert config.load(Settings, config.to_yaml(changed)) == changed


def test_names_of_all_settings():
    assert config.names(Settings)[-3:] == ["solver.iterations", "solver.tolerance", "solver.kernel"]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("solver.tolerance=1e-3", 1e-3),
        ("solver.tolerance=2", 2.0),
        ("levels=null", None),
        ("levels=3.0", 3),
        ("enabled=false", False),
        ("name=12", "12"),
        ("pair=[3, 4]", (3, 4.0)),
    ],
)
def test_values_are_coerced_to_the_declared_type(option, value):
    changed = config.override(Settings(levels=1), [option])
    found = changed.solver.tolerance if "solver" in option else getattr(changed, option.split("=")[0])
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("levls=3", r"--set: levls: no such setting; did you mean levels\?"),
        ("solver.iteratons=3", r"--set: solver.iteratons: no such setting; did you mean solver.iterations\?"),
        ("zzz=3", "known here: rounds, name, levels, enabled"),
        (
            "rounds=[{iteratons: 3}]",
            r"rounds.0..iteratons: no such setting; did you mean rounds.0..iterations",
        ),
        ("rounds=[3]", r"rounds.0.: 3 is a single value, but this is a group"),
        ("rounds=3", "rounds: 3 is not a list of values"),
        ("levels=many", "levels: 'many' is not a whole number or null"),
        ("levels=2.5", "levels: 2.5 is not a whole number or null"),
        ("levels=true", "levels: True is not a whole number"),
        ("enabled=1", "enabled: 1 is not true or false"),
        ("solver.kernel=cauchy", "solver.kernel: 'cauchy' is not one of huber, none"),
        ("solver.iterations=.inf", "solver.iterations: inf is not a whole number"),
        ("solver.iterations=0", "solver: iterations is 0, must be 1 or more"),
        ("solver=3", "solver: 3 is a single value, but this is a group; set solver.iterations"),
        ("pair=[1]", "pair: .1. is not a list of 2 values"),
        ("levels", "--set levels: not of the form name=value"),
        ("levels.a=3", "levels: .* is not a whole number or null"),
        ("solver.tolerance=" + "9" * 400, "solver.tolerance: 9+ is not a number"),
        (
            "solver.tolerance=0x" + "f" * 5000,
            "solver.tolerance: a number of very many digits is not a number",
        ),
        ("solver.iterations=" + "9" * 40, "solver.iterations: 9+ is not a whole number"),
        ("levels=2021-13-45", "levels: '2021-13-45' is not a whole number or null"),
        ("levels=" + "[" * 3000, "levels: .* is not a whole number or null"),
    ],
)
def test_mistakes_are_one_line_that_names_the_setting(option, message):
    with pytest.raises(InputError, match=message) as caught:
        config.override(Settings(), [option])
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("levels: [", r"my.yaml:\d+: not YAML"),
        ("- 1\n", "my.yaml: holds a list, not settings"),
        ("levels: 2021-13-45", "my.yaml: invalid value"),
        ("levels: " + "[" * 3000, "my.yaml: nested too deep"),
        ("solver:\n  iteratons: 3\n", "my.yaml: solver.iteratons: no such setting"),
        (
            "solver.iterations: 3\n",
            r"my.yaml: solver.iterations: .*; write them nested, solver: {iterations: ...}",
        ),
        (
            "solver.iteratons: 3\n",
            r"my.yaml: solver.iteratons: .*; write them nested, solver: {iterations: ...}",
        ),
        ("levels: 2\nlevels: 3\n", "my.yaml:2: levels is there twice; keep one"),
        (
            "solver:\n  iterations: 2\nlevels: 1\nsolver:\n  tolerance: 1\n",
            "my.yaml:4: solver is there twice",
        ),
        ("solver:\n  iterations: 2\n  iterations: 2\n", "my.yaml:3: iterations is there twice"),
    ],
)
def test_mistakes_in_a_file_name_the_file(text, message):
    with pytest.raises(InputError, match=message) as caught:
        config.load(Settings, text, where="my.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("depth", [40, 5000])
def test_names_of_thousands_of_dots_are_refused(depth):
    with pytest.raises(InputError, match="--set: settings: nested too deep") as caught:
        config.override(Config(), ["split." + "lit." * depth + "lit=1"])
    assert len(str(caught.value)) < 200

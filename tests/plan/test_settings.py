"""How settings are declared: text and range in one place, with the field, for people and for services."""

import pickle
from dataclasses import dataclass, field

import pytest
from pydantic import TypeAdapter

from lvba import config
from lvba.blocks.split import SplitConfig
from lvba.settings import RangeError, check, setting


@dataclass(frozen=True)
class Part:
    size: float = setting(
        2.0, meaning="How long a part is.", unit="m", low=0, high=1000, change_when="Parts are too large."
    )
    side: int = setting(3, meaning="Of a patch.", low=3, high=9, odd=True, change_when="", advanced=True)
    voxel: float = setting(-1.0, meaning="Edge.", low=0, high=9, also=(-1,), change_when="")
    rounds: tuple[SplitConfig, ...] = (SplitConfig(),)

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Older:
    """With a check of its own, which names no field."""

    low: int = 1
    high: int = 5

    def __post_init__(self):
        if not 0 < self.low < self.high < 9:
            raise ValueError(f"{self.low} and {self.high} are wrong")


@dataclass(frozen=True)
class All:
    part: Part = field(default_factory=Part)
    older: Older = field(default_factory=Older)


def test_a_service_that_is_given_the_dataclass_describes_it_with_text_and_range():
    found = TypeAdapter(Part).json_schema()["properties"]
    facts = {"default": 2.0, "minimum": 0, "maximum": 1000, "unit": "m", "level": "basic", "type": "number"}
    facts |= {"range": "0 to 1000", "meaning": "How long a part is.", "change_when": "Parts are too large."}
    text = "How long a part is. 0 to 1000 m. Change it when: Parts are too large."
    assert found["size"] == {**facts, "description": text, "title": "Size"}
    assert found["side"]["level"] == "advanced"
    assert found["voxel"]["description"] == "Edge. -1 or 0 to 9."
    assert "minimum" not in found["voxel"]  # JSON Schema would refuse -1


def test_range_names_its_field():
    with pytest.raises(RangeError) as refused:
        Part(side=4)
    assert refused.value.name == "side"


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"part": {"size": -1}}, "part.size"),
        ({"part": {"size": "long"}}, "part.size"),
        ({"part": {"sise": 1}}, "part.sise"),
        ({"part": 3}, "part"),
        ({"part": {"rounds": [{"memory_gb": 0}]}}, "part.rounds"),
        ({"older": {"low": 2, "high": 70}}, "older.high"),
        ({"older": {"low": 5, "high": 4}}, "older.low"),
        ({"older": {"low": 4, "high": 3}}, "older"),
    ],
)
def test_mistake_names_its_setting_also_after_a_journey_between_processes(values, name):
    with pytest.raises(config.SettingError) as refused:
        config.from_mapping(All, values)
    for error in (refused.value, pickle.loads(pickle.dumps(refused.value))):
        assert error.setting == name
        assert str(error) == str(refused.value)

"""The settings of a run: few, described, and each with an effect; those of version 0.1 that are none any more."""

import logging
import re
from pathlib import Path

import pytest
import yaml

from lvba import config, retired_settings, settings, settings_reference
from lvba.errors import InputError
from lvba.pipeline import Config

ROOT = Path(__file__).resolve().parents[2]
EVERY = list(settings.every(Config))


def nested(values):
    """Nested mappings from dotted names."""
    found = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        here = found
        for group in groups:
            here = here.setdefault(group, {})
        here[last] = value
    return found


def test_there_are_few():
    assert len(EVERY) <= 45
    assert [each.name for each in EVERY] == config.names(Config), "a field without a description"


@pytest.mark.parametrize("each", EVERY, ids=[each.name for each in EVERY])
def test_each_says_what_it_is_and_when_to_change_it(each):
    assert each.about.meaning.endswith(".")
    assert each.about.change_when.endswith(".")
    numeric = each.hint in (int, float)
    assert not numeric or each.about.low is not None, "a number without a range"


def test_page_is_made_from_them():
    assert (ROOT / "docs" / "settings.md").read_text() == settings_reference.text()


def test_config_yaml_has_all_of_them_with_what_they_mean_and_comes_back():
    changed = config.override(Config(), ["visual.levels=2", "split.starts=[3.5, 9]", "map.voxel_m=0.25"])
    text = config.to_yaml(changed)
    assert config.load(Config, text) == changed
    told = re.sub(r"\s*\n\s*# ", " ", text)
    for each in EVERY:
        assert each.about.meaning in told


def of_version_0_1(**changes):
    old = {each.name: each.default for each in EVERY} | retired_settings.DEFAULTS | changes
    return yaml.safe_dump(config._plain(nested(old)))


def test_config_of_an_earlier_version_is_read_with_one_short_warning(caplog):
    with caplog.at_level(logging.WARNING, "lvba"):
        loaded = config.load(Config, of_version_0_1(**{"visual.levels": 2}), where="old.yaml")
    assert loaded == config.override(Config(), ["visual.levels=2"])
    (record,) = caplog.records
    assert record.getMessage() == (
        "old.yaml: 98 settings of an earlier version are ignored: "
        "evaluate.colors, evaluate.entropy.min_neighbors, evaluate.entropy.voxel_m and 95 more (--verbose names all)"
    )


def test_all_ignored_settings_are_named_where_more_is_asked_for(caplog):
    with caplog.at_level(logging.DEBUG, "lvba"):
        config.load(Config, of_version_0_1(), where="old.yaml")
    listed = caplog.records[-1].getMessage()
    assert all(name in listed for name in retired_settings.DEFAULTS)


def test_few_ignored_settings_are_all_in_the_warning(caplog):
    config.load(Config, "merge: {align: true}", where="old.yaml")
    assert caplog.messages == ["old.yaml: ignored, because they were removed: merge.align"]


@pytest.mark.parametrize(
    ("name", "value", "mend"),
    [
        ("visual.exposures", "none", "without exposures"),
        ("visual.points.tries", 3, "runs use 12 always"),
        ("visual.points.patch_size", 7, "set visual.patch"),
        ("lidar.stages", [{"rounds": 2}], "dense_points"),
        ("visual.prior.enabled", False, "without the pose prior"),
    ],
)
def test_value_of_a_setting_that_is_none_any_more_is_an_error_with_the_mend(name, value, mend):
    with pytest.raises(InputError, match=re.escape(mend)) as refused:
        config.load(Config, of_version_0_1(**{name: value}), where="old.yaml")
    assert refused.value.setting == name
    assert f"old.yaml: {name}" in str(refused.value)


@pytest.mark.parametrize("old", retired_settings.RENAMED)
def test_renamed_settings_still_work_by_their_old_names(old):
    new = retired_settings.RENAMED[old]
    by_old, by_new = (config.override(Config(), [f"{name}=0.5"]) for name in (old, new))
    assert by_old == by_new != Config()
    both = nested({old: 0.25, new: 0.5})
    assert config.from_mapping(Config, both) == by_new


def test_no_setting_is_known_and_retired():
    names = {each.name for each in EVERY}
    assert not (retired_settings.DEFAULTS.keys() | retired_settings.RENAMED.keys()) & names
    assert set(retired_settings.RENAMED.values()) <= names


def test_mends_that_name_an_ablation_name_one_that_there_is(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    from benchmarks.ablations import ABLATIONS

    told = [
        found[1]
        for name in retired_settings.DEFAULTS
        if (found := re.search(r'benchmarks\.ablations "([^"]+)"', retired_settings.mend(name)))
    ]
    assert len(told) == 7
    assert set(told) <= set(ABLATIONS)

"""Presets of public data sets: all are whole, say what is not checked, and come with the package."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.sources import presets

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("hilti-2022", "hilti-2023", "m2dgr", "mars-lvig", "newer-college", "ntu-viral", "r3live")


def test_all_are_there():
    assert presets.names() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_says_what_it_knows_and_what_not(name):
    preset = presets.read(name)
    assert preset.title
    assert preset.origin.startswith("https://")
    assert preset.stamp in ("begin", "end")
    assert preset.unchecked
    if preset.imu_from_lidar:
        rotation = np.reshape(preset.imu_from_lidar, (3, 4))[:, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert all(
        topic.startswith("/")
        for topics in (preset.lidar, preset.images, preset.imu, preset.gnss)
        for topic in topics
    )


def test_offsets_of_sequences_are_those_of_fast_livo2():
    assert presets.read("mars-lvig").image_offsets_s["HKisland02"] == 0.1
    assert presets.read("ntu-viral").stamp == "end"


@pytest.mark.parametrize("name", ["kitti", "../x", ""])
def test_another_name_is_refused_with_those_that_there_are(name):
    with pytest.raises(InputError, match="choose one of hilti-2022, hilti-2023, m2dgr"):
        presets.read(name)


def test_presets_are_installed_with_the_package():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["lvba"]
    assert "sources/presets/*.yaml" in data

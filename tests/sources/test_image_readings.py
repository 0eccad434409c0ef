"""What is taken where an offset of images is measured beside usual answers: pairs that are parabolas of the offset."""

import struct
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from lvba import geometry
from lvba.io import images
from lvba.sources.importing import decision, image_readings, survey
from lvba.sources.source import RawImage

CAMERA_FROM_LIDAR = geometry.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
OFFSETS = {"+0": 0.0, "+0.1": 0.1, "-0.1": -0.1, "+0.05": 0.05, "-0.05": -0.05}


@dataclass(frozen=True)
class Pair:
    segment: int


@dataclass(frozen=True)
class Parabolas:
    """Pairs by which images are alike at offsets (s) about one, each at another one."""

    about: float
    spread: float
    added: float = field(default=0.0, kw_only=True)
    flat: float = 1.0
    segments: int = 12
    rough: float = 0.0
    camera_from_lidar: np.ndarray = field(default_factory=lambda: CAMERA_FROM_LIDAR)
    read: list[str] = field(default_factory=list)

    @property
    def pairs(self):
        return [Pair(number * self.segments // 12) for number in range(12)]

    def scores(self, reading):
        self.read.append(reading.extrinsic)
        normal = np.random.default_rng(0).normal(size=12)
        normal = np.repeat(normal[: self.segments], 12 // self.segments)
        best = self.about + self.spread * (normal - normal.mean()) / normal.std()
        wrong = 0.9 * (reading.extrinsic != "camera_from_lidar")
        phase = np.random.default_rng(1).uniform(0, 2 * np.pi, 12)
        rough = self.rough * np.sin(reading.offset / 5e-3 + phase)
        return self.flat * (0.03 + 8.0 * (reading.offset - best) ** 2) + rough + wrong

    def score(self, reading):
        return decision.mean(self.scores(reading))


def found(about, spread):
    return image_readings.find(Parabolas(about, spread), OFFSETS, {}, "here")


def test_an_unusual_answer_beside_what_is_measured_is_not_taken():
    read = found(-0.0267, 0.022)
    assert 0.005 < read.measured_sigma < 0.008
    assert read.reading.offset == pytest.approx(-0.0267, abs=1e-3)
    assert any("by what they show" in words for words in read.warnings)


@pytest.mark.parametrize(
    ("about", "taken"), [(0.0, "+0"), (0.002, "+0"), (-0.05, "-0.05"), (-0.046, "-0.05")]
)
def test_a_usual_answer_is_taken_without_a_word(about, taken):
    read = found(about, 0.008)
    assert read.reading.offset == OFFSETS[taken]
    assert not read.warnings


def test_an_offset_that_is_left_to_the_bundle_adjustment_is_told():
    read = found(0.015, 0.008)
    assert read.reading.offset == 0.0
    [words] = read.warnings
    assert "+15 ms" in words
    assert "image_offset=0.0150" in words


def test_pairs_of_one_segment_err_together():
    apart = found(0.0, 0.02)
    together = image_readings.find(Parabolas(0.0, 0.02, segments=4), OFFSETS, {}, "here")
    # four differing segments instead of twelve pairs
    assert together.measured_sigma == pytest.approx(apart.measured_sigma * np.sqrt(11 / 3), rel=0.02)


def test_the_nearest_point_of_each_cell_hides_those_behind():
    rng = np.random.default_rng(3)
    column, row = rng.uniform(1, 300, 500), rng.uniform(1, 200, 500)
    depth = rng.uniform(1, 20, 500)
    cell = [(int(x) // 12, int(y) // 12) for x, y in zip(column, row, strict=True)]
    nearest = {each: min(d for d, c in zip(depth, cell, strict=True) if c == each) for each in cell}
    expected = [d <= nearest[c] * 1.05 + 0.2 for d, c in zip(depth, cell, strict=True)]
    assert image_readings._in_front(column, row, depth).tolist() == expected
    assert image_readings._in_front(column[:0], row[:0], depth[:0]).tolist() == []


def test_rough_scores_are_looked_at_more_widely():
    read = image_readings.find(Parabolas(0.0, 0.008, rough=0.02), OFFSETS, {}, "here")
    assert abs(read.measured) < 3 * read.measured_sigma < 0.012
    assert read.reading.offset == 0.0
    assert not read.warnings


HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""Its own inverse, as the identity is."""


@pytest.mark.parametrize("same", [np.eye(4), HALF_TURN, HALF_TURN.round(6) + 1e-7 * np.eye(4)])
def test_an_extrinsic_that_is_its_own_inverse_is_no_question(same):
    images = Parabolas(0.0, 0.008, camera_from_lidar=same)
    read = image_readings.find(images, OFFSETS, {}, "here")
    assert not read.warnings
    assert read.decisions[0].facts() == {"taken": "camera_from_lidar", "by": "only"}
    assert set(images.read) == {"camera_from_lidar"}
    said = image_readings.find(images, OFFSETS, {"extrinsic": "lidar_from_camera"}, "here")
    assert said.decisions[0].facts() == {"taken": "lidar_from_camera", "by": "option"}


def test_an_extrinsic_that_is_not_quite_its_own_inverse_is_a_question():
    shifted = HALF_TURN.copy()
    shifted[0, 3] = 1e-3
    read = image_readings.find(Parabolas(0.0, 0.008, camera_from_lidar=shifted), OFFSETS, {}, "here")
    assert dict(read.decisions[0].scores).keys() == {"camera_from_lidar", "lidar_from_camera"}


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_images_are_judged_as_they_are_stored(tmp_path, orientation):
    """EXIF says how a viewer turns an image; files, calibrations and `lvba run` have it as it was read out."""
    ramp = np.linspace(0, 255, 60 * 80).reshape(60, 80).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", ramp)
    tag = struct.pack("<HHIHHI", 0x0112, 3, 1, orientation, 0, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + tag
    content = encoded.tobytes()
    content = content[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + content[2:]
    (tmp_path / "a.jpg").write_bytes(content)
    gray = survey.gray_of(RawImage(0, "camera", content, None, ".jpg"))
    np.testing.assert_array_equal(gray, images.read_image(tmp_path / "a.jpg")[..., 0])
    assert np.abs(gray.astype(int) - ramp).max() < 10

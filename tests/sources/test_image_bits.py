"""Images of cameras that use fewer bits than their files have."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from changed_sources import changed

from lvba.io import images
from lvba.io.dataset import open_dataset
from lvba.sources.importing import conventions, image_bits
from lvba.sources.importing.importer import import_source
from lvba.sources.source import RawImage

pytestmark = pytest.mark.usefixtures("one_pair")


@pytest.mark.parametrize(
    ("largest", "bits"),
    [(0, 16), (1, 8), (255, 8), (256, 10), (1023, 10), (4000, 12), (16383, 14), (16384, 16), (65535, 16)],
)
def test_bits_are_those_that_the_largest_value_needs(largest, bits):
    assert image_bits.used(largest) == bits


def deep(bits, encoded, color):
    """A change of a source: images of 16 bits, of which so many are used; the brightest value is in one of them only."""
    seen = []

    def change(name, record):
        if not isinstance(record, RawImage):
            return [(name, record)]
        rgb = cv2.imdecode(np.frombuffer(record.encoded, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        pixels = (rgb if color else rgb[..., 1]).astype(np.uint16) << (bits - 8)
        seen.append(pixels)
        if len(seen) == 5:
            pixels[0, 0] = (1 << bits) - 1
        if not encoded:
            return [(name, replace(record, encoded=None, pixels=pixels))]
        stored = cv2.imencode(".png", pixels[..., ::-1] if color else pixels)[1].tobytes()
        return [(name, replace(record, encoded=stored, suffix=".png"))]

    return change, seen


@pytest.mark.parametrize("encoded", [False, True])
@pytest.mark.parametrize("color", [False, True])
def test_images_of_12_bits_in_16_are_as_bright_as_they_were(tmp_path, small_source, encoded, color):
    change, seen = deep(12, encoded, color)
    report = import_source(changed(small_source, change), tmp_path / "out")
    dataset = open_dataset(tmp_path / "out")
    assert len(dataset.image_paths) >= 8
    assert len(report.facts["notes"]) == 1
    assert report.facts["notes"][0].startswith("images: no value of their 16 bits is above 4095")
    off = []
    for path in dataset.image_paths:
        pixels = images.decoded(path)
        assert pixels.dtype == np.uint16
        pixels = pixels[..., ::-1] if color else pixels
        off.append(min(np.abs(pixels.astype(int) - 16 * one.astype(int)).max() for one in seen))
    assert max(off) == 0


def test_images_that_use_all_16_bits_stay_as_they_are(tmp_path, small_source):
    change, seen = deep(16, True, False)
    written = changed(small_source, change)
    report = import_source(written, tmp_path / "out")
    stored = {record.encoded for _, record in written.items if isinstance(record, RawImage)}
    for path in open_dataset(tmp_path / "out").image_paths:
        with open(path, "rb") as file:
            assert file.read() in stored
    assert report.facts["notes"] == []
    assert seen


def test_what_images_show_is_judged_by_the_bits_they_use(tmp_path, small_source, monkeypatch):
    samples = []
    monkeypatch.setattr(
        conventions.image_readings,
        "find",
        lambda scorer, *more, find=conventions.image_readings.find: (
            samples.extend(scorer.pairs) or find(scorer, *more)
        ),
    )
    import_source(changed(small_source, deep(12, False, False)[0]), tmp_path / "out")
    assert len(samples) > 1
    assert max(int(pair.one.gray.max()) for pair in samples) > 100

"""Any bytes in place of a file: an InputError or a sound value, in little time and memory."""

import os
import resource
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_recording
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lvba.errors import InputError
from lvba.io import camera_config, exposures, images, pcd, tum
from lvba.io.dataset import load_image, load_scans, open_dataset

FUZZ = settings(
    deadline=20_000,  # ms: far more than any takes, far less than a hang, also where others want the processor
    max_examples=100,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(autouse=True)
def _little_memory():
    """A reader that believes a hostile header meets this limit, and MemoryError is no InputError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as statm:
        now = int(statm.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (now + 1024**3, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


NUMBERS = [b"0", b"-1", b"4294967295", b"99999999999", b"nan", b"1e99"]


def _sound_scan(path: Path) -> None:
    scan = pcd.read_pcd(path)
    assert 0 < len(scan.points) <= path.stat().st_size * 88
    assert np.isfinite(scan.points).all()


def _sound_image(path: Path) -> None:
    rgb = images.read_image(path)
    assert rgb.ndim == 3
    assert rgb.shape[2] == 3
    assert rgb.size


def _sound_poses(path: Path) -> None:
    found = tum.read_trajectory(path)
    assert np.isfinite(found.world_from_sensor).all()
    assert (np.diff(found.times) > 0).all()


def _sound_calibration(path: Path) -> None:
    found = camera_config.read_calibration(path.parent)
    if found.camera is not None:
        assert found.camera.fx > 0
        assert 0 < found.camera.width <= 100_000


def _only_input_errors(read: Callable[[Path], object], path: Path, content: bytes) -> None:
    path.write_bytes(content)
    try:
        read(path)
    except InputError as error:
        _check_message(error)


def _check_message(error: InputError) -> None:
    assert len(str(error).splitlines()) == 1
    assert len(str(error)) < 1000


def _pcd_bytes(encoding: str) -> Callable[[Path], bytes]:
    def make(folder: Path) -> bytes:
        rng = np.random.default_rng(0)
        pcd.write_pcd(folder / "valid.pcd", rng.normal(size=(9, 3)), rng.random(9), rng.random(9), encoding)
        return (folder / "valid.pcd").read_bytes()

    return make


def _image_bytes(suffix: str) -> Callable[[Path], bytes]:
    def make(folder: Path) -> bytes:
        pixels = np.random.default_rng(0).integers(0, 255, (8, 9, 3)).astype(np.uint8)
        images.write_image(folder / f"valid{suffix}", pixels)
        return (folder / f"valid{suffix}").read_bytes()

    return make


READERS: dict[str, tuple[str, Callable[[Path], object], Callable[[Path], bytes]]] = {
    "ascii": ("a.pcd", _sound_scan, _pcd_bytes("ascii")),
    "binary": ("a.pcd", _sound_scan, _pcd_bytes("binary")),
    "compressed": ("a.pcd", _sound_scan, _pcd_bytes("binary_compressed")),
    "check": ("a.pcd", pcd.check_pcd, _pcd_bytes("binary")),
    "png": ("a.png", _sound_image, _image_bytes(".png")),
    "jpg": ("a.jpg", _sound_image, _image_bytes(".jpg")),
    "tum": ("a.txt", _sound_poses, lambda _: b"1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0.5 0.5 0.5 0.5\n# c\n"),
    "csv": ("a.csv", exposures.read_exposures, lambda _: b"timestamp,relative_exposure\n1.5,1\n2.5,0.75\n"),
    "yaml": ("config.yaml", _sound_calibration, lambda _: small_recording.CONFIG.encode()),
}


@pytest.mark.parametrize("name", READERS)
@given(content=st.binary(max_size=300))
@FUZZ
def test_random_bytes(tmp_path: Path, name: str, content: bytes):
    file_name, read, _ = READERS[name]
    _only_input_errors(read, tmp_path / file_name, content)


@pytest.mark.parametrize("name", READERS)
@given(data=st.data())
@FUZZ
def test_mutated_files(tmp_path: Path, name: str, data: st.DataObject):
    """Bytes changed, cut out, doubled and put in, numbers blown up; image checksums made right again."""
    file_name, read, make = READERS[name]
    content = bytearray(make(tmp_path))
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, max(len(content) - 1, 0)))
        span = data.draw(st.sampled_from([1, 1, 2, 4, 20, 500]))
        kind = data.draw(st.sampled_from(["set", "cut", "double", "insert", "digits"]))
        if kind == "set":
            content[place : place + 1] = bytes([data.draw(st.integers(0, 255))])
        elif kind == "cut":
            del content[place : place + span]
        elif kind == "double":
            content[place:place] = content[place : place + span]
        elif kind == "insert":
            content[place:place] = data.draw(st.binary(max_size=8))
        else:
            digits = [i for i in range(len(content)) if chr(content[i]).isdigit()]
            if digits:
                at = digits[place % len(digits)]
                content[at : at + 1] = data.draw(st.sampled_from(NUMBERS))
    if name == "png" and data.draw(st.booleans()):
        content = _with_right_checksums(bytes(content))
    _only_input_errors(read, tmp_path / file_name, bytes(content))


def _with_right_checksums(content: bytes) -> bytearray:
    """The PNG with the checksum of each whole part made right, so that damage gets as far as the decoder."""
    result, position = bytearray(content), 8
    while position + 12 <= len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        end = position + 12 + length
        if end > len(content):
            break
        result[end - 4 : end] = zlib.crc32(content[position + 4 : end - 4]).to_bytes(4, "big")
        position = end
    return result


@given(data=st.data())
@settings(FUZZ, max_examples=40)
def test_recordings_with_a_mutated_file(tmp_path_factory, data: st.DataObject):
    root = small_recording.write(tmp_path_factory.mktemp("fuzz"), scans=3, pictures=3)
    chosen = data.draw(st.sampled_from(sorted(path for path in root.rglob("*") if path.is_file())))
    content = bytearray(chosen.read_bytes())
    start = data.draw(st.integers(0, len(content)))
    content[start : start + data.draw(st.integers(0, 60))] = data.draw(st.binary(max_size=20))
    chosen.write_bytes(content)
    try:
        found = open_dataset(root)
        load_scans(found)
        for index in range(len(found.image_paths)):
            load_image(found, index)
    except InputError as error:
        _check_message(error)
        return
    assert np.isfinite(found.scans.world_from_sensor).all()
    assert (np.diff(found.scans.times) > 0).all()
    assert (np.diff(found.images.times) > 0).all()

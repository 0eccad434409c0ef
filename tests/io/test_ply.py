"""PLY files: what is written is read back; what is broken is named."""

from itertools import pairwise

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import ply, stream


def columns(count=1000):
    rng = np.random.default_rng(0)
    return {
        "x": rng.normal(size=count).astype(np.float32),
        "y": rng.normal(size=count),
        "red": rng.integers(0, 256, count).astype(np.uint8),
        "views": rng.integers(0, 60000, count).astype(np.uint16),
        "count": rng.integers(-5, 5, count).astype(np.int32),
    }


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_columns_are_read_back(tmp_path, count, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK", 300)
    ply.write_ply(tmp_path / "a.ply", columns(count), comments=("made by a test",))
    back = ply.read_ply(tmp_path / "a.ply")
    for name, values in columns(count).items():
        assert back[name].dtype == values.dtype
        np.testing.assert_array_equal(back[name], values)
    assert sum(len(chunk) for chunk in ply.read_ply_chunks(tmp_path / "a.ply", chunk=77)) == count


def test_other_programs_read_it(tmp_path):
    o3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(1)
    xyz, rgb = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 256, (50, 3)).astype(np.uint8)
    table = dict(zip("xyz", xyz.T)) | dict(zip(("red", "green", "blue"), rgb.T)) | {"views": rgb[:, 0]}
    ply.write_ply(tmp_path / "a.ply", table)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), xyz)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, rgb, atol=0.01)


def test_a_truncated_file_is_named(tmp_path):
    path = tmp_path / "a.ply"
    ply.write_ply(path, columns())
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"a\.ply.*fewer than the 1000 points"):
        ply.read_ply(path)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "not a PLY"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "binary little-endian",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nproperty float x\nend_header\n",
            "plain vertices",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int f\nend_header\n",
            "plain",
        ),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty funny x\nend_header\n", "plain"),
    ],
)
def test_other_kinds_of_files_are_refused(tmp_path, content, problem):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=problem):
        ply.read_ply(path)


def test_types_that_ply_lacks_are_refused(tmp_path):
    with pytest.raises(ValueError, match="int64"):
        ply.write_ply(tmp_path / "a.ply", {"x": np.zeros(3, np.int64)})


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(TypeError), stream.writer(path) as file:
        file.writelines([b"half of the n", "not bytes"])
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        ply.write_ply(tmp_path / "nowhere" / "a.ply", columns())


def test_pieces_make_the_file_of_the_whole(tmp_path):
    whole = columns(1000)
    ply.write_ply(tmp_path / "whole.ply", whole)
    cuts = [0, 0, 300, 301, 1000]
    pieces = [{name: values[a:b] for name, values in whole.items()} for a, b in pairwise(cuts)]
    ply.write_ply_pieces(tmp_path / "pieces.ply", 1000, pieces)
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    with pytest.raises(ValueError, match="1 rows more"):
        ply.write_ply_pieces(tmp_path / "short.ply", 1001, pieces)
    assert not (tmp_path / "short.ply").exists()

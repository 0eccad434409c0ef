"""COLMAP models, text and binary: cameras, rigs, frames, images and points with their tracks.

COLMAP puts the center of the first pixel at (0.5, 0.5), lvba at (0, 0): the half pixel is added here and nowhere else.
Format: https://colmap.github.io/format.html (rigs and frames since 3.12; older readers ignore those files).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.io import files, stream

_PINHOLE = 1
_CAMERA_SENSOR = 0


@dataclass(frozen=True)
class ColmapModel:
    """One pinhole camera, its images, and points with the pixels that show them. Ids are indices + 1.

    names: file names of the I images, below images/
    world_from_camera: (I, 4, 4) float64
    points_world: (P, 3) float64, m; rgb: (P, 3) uint8
    track_point, track_image: (O,) int32, indices: the point is seen in the image; sorted by (point, image)
    track_pixel: (O, 2) float64, (column, row), lvba's convention
    """

    camera: Camera
    names: tuple[str, ...]
    world_from_camera: np.ndarray
    points_world: np.ndarray
    rgb: np.ndarray
    track_point: np.ndarray
    track_image: np.ndarray
    track_pixel: np.ndarray


def write_model(folder: str | Path, model: ColmapModel) -> None:
    """Writes cameras, rigs, frames, images and points3D, each as .txt and .bin.

    Raises: InputError if a file cannot be written.
    """
    folder = files.make_folder(folder)
    for name, parts in (
        ("cameras.txt", _cameras_text(model)),
        ("cameras.bin", _cameras_binary(model)),
        ("rigs.txt", _rigs_text()),
        ("rigs.bin", _rigs_binary()),
        ("frames.txt", _frames_text(model)),
        ("frames.bin", _frames_binary(model)),
        ("images.txt", _images_text(model)),
        ("images.bin", _images_binary(model)),
        ("points3D.txt", _points_text(model)),
        ("points3D.bin", _points_binary(model)),
    ):
        with stream.writer(folder / name) as file:
            for part in parts:
                file.write(part)


def _parameters(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5


def _poses(model: ColmapModel) -> np.ndarray:
    """qw qx qy qz tx ty tz of camera_from_world, (I, 7)."""
    camera_from_world = geometry.inverse(model.world_from_camera)
    turned = geometry.quaternion(camera_from_world)
    return np.concatenate([turned[:, 3:], turned[:, :3], camera_from_world[:, :3, 3]], axis=1)


def _by_image(model: ColmapModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the tracks by (image, point), where each image starts in it, and each track's place in its image."""
    order = np.lexsort((model.track_point, model.track_image))
    start = np.searchsorted(model.track_image[order], np.arange(len(model.names) + 1))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) - start[model.track_image[order]]
    return order, start, place


def _words(row: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in row)


def _cameras_text(model: ColmapModel) -> Iterator[bytes]:
    camera = model.camera
    yield b"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    yield f"1 PINHOLE {camera.width} {camera.height} {_words(np.array(_parameters(camera)))}\n".encode()


def _cameras_binary(model: ColmapModel) -> Iterator[bytes]:
    camera = model.camera
    yield np.array([1], "<u8").tobytes() + np.array([1, _PINHOLE], "<i4").tobytes()
    yield np.array([camera.width, camera.height], "<u8").tobytes()
    yield np.array(_parameters(camera), "<f8").tobytes()


def _rigs_text() -> Iterator[bytes]:
    yield b"# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]\n1 1 CAMERA 1\n"


def _rigs_binary() -> Iterator[bytes]:
    yield np.array([1], "<u8").tobytes() + np.array([1, 1], "<u4").tobytes()
    yield np.array([_CAMERA_SENSOR], "<i4").tobytes() + np.array([1], "<u4").tobytes()


def _frames_text(model: ColmapModel) -> Iterator[bytes]:
    yield b"# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW QX QY QZ TX TY TZ], NUM_DATA_IDS, DATA_IDS[] (TYPE, SENSOR, DATA)\n"
    for i, pose in enumerate(_poses(model), 1):
        yield f"{i} 1 {_words(pose)} 1 CAMERA 1 {i}\n".encode()


def _frames_binary(model: ColmapModel) -> Iterator[bytes]:
    yield np.array([len(model.names)], "<u8").tobytes()
    for i, pose in enumerate(_poses(model), 1):
        yield (
            np.array([i, 1], "<u4").tobytes() + pose.astype("<f8").tobytes() + np.array([1], "<u4").tobytes()
        )
        yield np.array([_CAMERA_SENSOR], "<i4").tobytes() + np.array([1], "<u4").tobytes()
        yield np.array([i], "<u8").tobytes()


def _images_text(model: ColmapModel) -> Iterator[bytes]:
    order, start, _ = _by_image(model)
    yield b"# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    for i, pose in enumerate(_poses(model)):
        rows = order[start[i] : start[i + 1]]
        seen = zip(model.track_pixel[rows] + 0.5, model.track_point[rows] + 1, strict=True)
        points = " ".join(f"{x:.3f} {y:.3f} {point}" for (x, y), point in seen)
        yield f"{i + 1} {_words(pose)} 1 {model.names[i]}\n{points}\n".encode()


def _images_binary(model: ColmapModel) -> Iterator[bytes]:
    order, start, _ = _by_image(model)
    yield np.array([len(model.names)], "<u8").tobytes()
    for i, pose in enumerate(_poses(model)):
        rows = order[start[i] : start[i + 1]]
        yield (
            np.array([i + 1], "<u4").tobytes() + pose.astype("<f8").tobytes() + np.array([1], "<u4").tobytes()
        )
        yield model.names[i].encode() + b"\0" + np.array([len(rows)], "<u8").tobytes()
        table = np.empty(len(rows), [("pixel", "<f8", 2), ("point", "<u8")])
        table["pixel"], table["point"] = model.track_pixel[rows] + 0.5, model.track_point[rows] + 1
        yield table.tobytes()


def _tracks(model: ColmapModel) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Per point its index, and the (image id, place among the image's points) of its track."""
    _, _, place = _by_image(model)
    start = np.searchsorted(model.track_point, np.arange(len(model.points_world) + 1))
    table = np.stack([model.track_image + 1, place], axis=1).astype("<u4")
    for p in range(len(model.points_world)):
        yield p, model.points_world[p], table[start[p] : start[p + 1]]


def _points_text(model: ColmapModel) -> Iterator[bytes]:
    yield b"# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    for p, xyz, track in _tracks(model):
        color = " ".join(map(str, model.rgb[p]))
        seen = "".join(f" {image} {place}" for image, place in track)
        yield f"{p + 1} {xyz[0]:.5f} {xyz[1]:.5f} {xyz[2]:.5f} {color} 0{seen}\n".encode()


def _points_binary(model: ColmapModel) -> Iterator[bytes]:
    yield np.array([len(model.points_world)], "<u8").tobytes()
    head = np.zeros(
        1, [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    )
    for p, xyz, track in _tracks(model):
        head["id"], head["xyz"], head["rgb"], head["length"] = p + 1, xyz, model.rgb[p], len(track)
        yield head.tobytes() + track.tobytes()

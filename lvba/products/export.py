"""A result folder in other formats: LAS and LAZ, COLMAP models, nerfstudio datasets, octrees with levels of detail."""

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import calibration, colmap, files, images, laz, nerfstudio, ply, result_folder
from lvba.io import crs as coordinates
from lvba.io import dataset as recordings
from lvba.parallel import in_order
from lvba.products import lod, measured, viewer
from lvba.products.cloud import thin_to
from lvba.products.measured import Measured
from lvba.products.tracks import visible
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.visual.image import Undistorter
from lvba.visual.trajectory_rates import turns_of

logger = logging.getLogger(__name__)

MAX_POINTS = 200_000
"""Points of a COLMAP or nerfstudio model: enough to start a trainer from, few enough for its loader."""


def export(
    result: str | Path,
    kind: str,
    out: str | Path | None = None,
    progress: Progress = silent,
    *,
    crs: str = "",
) -> Path:
    """Writes a result folder in another format and returns where it is.

    kind: one of FORMATS; out: file or folder to write, or None for a name inside the result folder.
    crs: for las and laz, what the coordinates are of: WKT, a file of it, or EPSG:CODE; nothing is converted
    Raises: InputError if the result folder lacks something, the format is unknown, or nothing can be written.
    """
    result = Path(result)
    if kind not in FORMATS:
        raise InputError(kind, "is no format known here", f"choose one of {', '.join(FORMATS)}")
    if not (result / "map.ply").exists():
        raise InputError(result, "holds no map.ply", "give the folder that `lvba run` wrote")
    name, write = FORMATS[kind]
    target = Path(out) if out is not None else result / name
    if kind in ("las", "laz"):
        _las(result, target, progress, coordinates.wkt(crs) if crs else "")
    elif crs:
        raise InputError(f"--crs {crs}", f"{kind} keeps no coordinate reference system", "export las or laz")
    else:
        write(result, target, progress)
    return target


def _ply(result: Path, out: Path, progress: Progress) -> None:
    files.write_bytes(out, files.read_bytes(result / "map.ply", limit=1 << 40))


def _las(result: Path, out: Path, progress: Progress, wkt: str = "") -> None:
    first = next(ply.read_ply_chunks(result / "map.ply"))
    names = first.dtype.names or ()
    extra = {name: first.dtype[name] for name in names if name not in ("x", "y", "z", "red", "green", "blue")}
    corner = np.array([first[name].min() for name in "xyz"], float) if len(first) else np.zeros(3)
    measured_ = _measured(result, progress)
    adjusted = measured_ is not None and measured_.adjusted
    laz.write_las(out, _las_chunks(result, measured_), extra, corner, wkt=wkt, adjusted_time=adjusted)


def _measured(result: Path, progress: Progress) -> Measured | None:
    try:
        return measured.of_map(result, _recording, progress)
    except InputError as error:
        logger.warning("the points go without time, intensity and scan: %s", error)
        return None


def _las_chunks(result: Path, attributes: Measured | None) -> Iterator[dict[str, np.ndarray]]:
    done = 0
    for chunk in ply.read_ply_chunks(result / "map.ply"):
        columns = {name: chunk[name] for name in chunk.dtype.names or ()}
        if attributes is not None:
            here = slice(done, done + len(chunk))
            values = (attributes.gps_time[here], attributes.intensity[here], attributes.source[here])
            columns |= dict(zip(laz.MEASURED, values, strict=True))
        done += len(chunk)
        yield columns


def _colmap(result: Path, out: Path, progress: Progress) -> None:
    scene = _Scene(result)
    names = scene.write_images(out / "images", progress)
    points, rgb = scene.start_points()
    views = scene.views()
    point, image, pixel = visible(points, scene.map_points, views)
    model = colmap.ColmapModel(
        camera=scene.camera,
        names=names,
        world_from_camera=views.world_from_camera,
        points_world=points,
        rgb=rgb,
        track_point=point,
        track_image=image,
        track_pixel=pixel,
    )
    colmap.write_model(out / "sparse" / "0", model)
    scene.write_offset(out)


def _nerfstudio(result: Path, out: Path, progress: Progress) -> None:
    scene = _Scene(result)
    names = scene.write_images(out / "images", progress)
    points, rgb = scene.start_points()
    axes = dict(zip("xyz", points.astype(np.float32).T, strict=True))
    colors = dict(zip(("red", "green", "blue"), rgb.T, strict=True))
    ply.write_ply(out / "points.ply", axes | colors)
    nerfstudio.write_transforms(out, scene.camera, names, scene.world_from_camera, "points.ply")
    scene.write_offset(out)


def _lod(result: Path, out: Path, progress: Progress) -> None:
    lod.write(result / "map.ply", out / "cloud", progress=progress)
    try:
        dataset = _recording(result)
    except InputError as error:
        logger.warning("the octree goes without cameras and pictures: %s", error)
        return
    viewer.write(result, dataset, out, progress)


FORMATS: dict[str, tuple[str, Callable[[Path, Path, Progress], None]]] = {
    "ply": ("export.ply", _ply),
    "las": ("map.las", _las),
    "laz": ("map.laz", _las),
    "colmap": ("colmap", _colmap),
    "nerfstudio": ("nerfstudio", _nerfstudio),
    "lod": (".", _lod),
}
"""Name of the format, name of what it writes by default, and who writes it."""


class _Scene:
    """Result and recording together, in the recording's shifted frame, images undistorted and cut to what is valid."""

    def __init__(self, result: Path) -> None:
        self.dataset = _recording(result)
        trajectory = result_folder.read_cameras(result, self.dataset)
        pairs = np.searchsorted(trajectory.times, self.dataset.images.times - 1e-6)
        if len(trajectory) != len(self.dataset.images) or (pairs != np.arange(len(trajectory))).any():
            raise InputError(
                result, "has other images than its recording", "run again on the recording as it is now"
            )
        self.world_from_camera = trajectory.world_from_sensor
        columns = ply.read_ply(result / "map.ply")
        world = np.stack([columns[name] for name in "xyz"], axis=1).astype(float) - self.dataset.origin
        self.map_points = world.astype(np.float32)
        self.rgb = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
        self.colored = columns["views"] > 0
        self._undistort = Undistorter(self.dataset.camera)
        self._turns = turns_of(trajectory, calibration.read_readout(result))
        self._cut = valid_rectangle(_valid(self._undistort, self._turns))
        if min(side.stop - side.start for side in self._cut) < 1:
            mend = "check the camera's focal length, principal point and distortion"
            raise InputError(
                self.dataset.root, "nothing is left of its images without their distortion", mend
            )
        self.camera = _cut_camera(self.dataset.camera.undistorted(), self._cut)

    def views(self) -> Views:
        """The cut images at the result's poses (no pixels are needed)."""
        times = self.dataset.images.times
        return Views(
            load=self._load,
            camera=self.camera,
            times=times,
            world_from_camera=self.world_from_camera,
            log_exposure=np.zeros(len(times)),
        )

    def _load(self, i: int) -> np.ndarray:
        turn = None if self._turns is None else self._turns[i]
        return np.ascontiguousarray(self._undistort(recordings.load_image(self.dataset, i), turn)[self._cut])

    def write_images(self, folder: Path, progress: Progress) -> tuple[str, ...]:
        """Writes the images and returns their names, those of the recording."""
        files.make_folder(folder)
        names = tuple(Path(path).stem + ".png" for path in self.dataset.image_paths)

        def write(i: int) -> None:
            images.write_image(folder / names[i], self._load(i))

        for done, _ in enumerate(in_order(write, range(len(names)))):
            progress("write images", done + 1, len(names))
        return names

    def start_points(self) -> tuple[np.ndarray, np.ndarray]:
        """At most MAX_POINTS colored points, evenly spread: (P, 3) float64 and colors (P, 3) uint8."""
        points, rgb = self.map_points[self.colored], self.rgb[self.colored]
        kept = thin_to(points, MAX_POINTS)
        return points[kept].astype(float), rgb[kept]

    def write_offset(self, folder: Path) -> None:
        """Says what must be added to get the coordinates of the recording."""
        x, y, z = self.dataset.origin
        if self.dataset.origin.any():
            files.write_text(folder / "offset.txt", f"{x} {y} {z}\n")


def valid_rectangle(valid: np.ndarray) -> tuple[slice, slice]:
    """A large rectangle (rows, columns) in which every pixel of (H, W) bool is valid: the emptiest side goes first.

    valid: (H, W) bool, pixels that hold a picture
    """
    top, bottom, left, right = 0, valid.shape[0], 0, valid.shape[1]
    while top < bottom and left < right:
        inner = ~valid[top:bottom, left:right]
        sides = [inner[0].mean(), inner[-1].mean(), inner[:, 0].mean(), inner[:, -1].mean()]
        worst = int(np.argmax(sides))
        if not inner.any():
            break
        if sides[worst] == 0:  # a hole inside: cut the image as if its edge were there
            worst = int(np.argmin(inner.shape))
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def _valid(undistort: Undistorter, turns: np.ndarray | None) -> np.ndarray:
    """(H, W) bool: which pixels hold a picture in all images. turns: (I, 3) float64, rad; those that turn most decide"""
    if turns is None:
        return ~undistort.empty()
    extreme = {*turns.argmin(axis=0), *turns.argmax(axis=0)}
    return np.asarray(~np.logical_or.reduce([undistort.empty(turns[image]) for image in extreme]))


def _cut_camera(camera: Camera, cut: tuple[slice, slice]) -> Camera:
    rows, columns = cut
    return Camera(
        width=columns.stop - columns.start, height=rows.stop - rows.start, fx=camera.fx, fy=camera.fy,
        cx=camera.cx - columns.start, cy=camera.cy - rows.start,
    )  # fmt: skip


def _recording(result: Path) -> Dataset:
    """The recording that a result was made from, by the path in its report, with the camera as the result has it."""
    report = result / "report.json"
    try:
        path = json.loads(files.read_text(report))["dataset"]["path"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(report, "does not say which recording it is of", "run again") from error
    dataset = recordings.open_dataset(path)
    camera = calibration.read_camera(result) if dataset.image_paths else None
    return dataset if camera is None else dataset.with_camera(camera)

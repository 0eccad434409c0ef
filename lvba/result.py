"""What a run gives, and the folder it is written to."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from lvba import config as settings
from lvba import pipeline, plan
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import calibration, ply, result_folder
from lvba.io.reference import Reference
from lvba.pipeline import Config
from lvba.plan import Plan, Store
from lvba.products import map_file, report
from lvba.products.map_file import PointMap
from lvba.products.pictures import Pictures
from lvba.progress import Progress, silent
from lvba.visual.radiometry import NONE, Radiometry


@dataclass(frozen=True)
class MapPieces:
    """The map in pieces that lie side by side, read from where they are kept, one at a time."""

    store: Store
    keys: tuple[str, ...]

    def __iter__(self) -> Iterator[PointMap]:
        for key in self.keys:
            yield self.store[key]
            if hasattr(self.store, "release"):
                self.store.release(key)


@dataclass(frozen=True)
class Result:
    """Refined poses and exposures, the colored map and the facts of the report.

    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4) float64, in the dataset's world frame
    relative_exposure: (I,) float64, first image 1
    report: plain data, see docs/report.md
    """

    dataset: Dataset
    config: Config
    world_from_scan: np.ndarray
    world_from_camera: np.ndarray
    relative_exposure: np.ndarray
    pieces: MapPieces
    pictures: Pictures | None
    report: dict[str, Any]
    camera: Camera | None = None
    """Of the raw images, as the camera poses suppose it; None: there are none."""
    radiometry: Radiometry = NONE
    """Of the images, as the exposures suppose it."""

    @cached_property
    def map(self) -> PointMap:
        """The colored map, whole: in memory from the first look on."""
        return map_file.together(list(self.pieces))

    def write(self, out: str | Path) -> None:
        """Write the result folder; each file in it is the old one or the whole new one.

        Raises InputError: it cannot be written, or holds such files that are not of a result.
        """
        result_folder.check(out)
        folder = result_folder.prepare(out)
        with result_folder.writing(folder):
            result_folder.write_poses(folder, self.dataset, self.world_from_scan, self.world_from_camera)
            if len(self.relative_exposure):
                result_folder.write_exposures(folder, self.dataset, self.relative_exposure)
                self._write_calibration(folder)
            self._write_map(folder / result_folder.MAP)
            result_folder.write_config(folder, settings.to_yaml(self.config))
            report.write(folder, self.report, self.pictures)

    def _write_calibration(self, folder: Path) -> None:
        assert self.camera is not None
        refined = (self.report.get("visual") or {}).get("calibration") or {}
        used = refined if refined.get("used") else {}
        extrinsic = used.get("camera_from_scan", self.dataset.camera_from_scan)
        calibration.write(
            folder,
            self.camera,
            np.asarray(extrinsic, float),
            used.get("time_offset", 0.0),
            used.get("readout", 0.0),
            used.get("sigma", {}),
            self.radiometry.vignetting.numbers if self.radiometry.vignetting else None,
            self.radiometry.response.table if self.radiometry.response else None,
            (used["clock_rate"], used["clock_epoch"]) if "clock_rate" in used else None,
        )

    def _write_map(self, path: Path) -> None:
        origin = self.dataset.origin
        stored = map_file.layout(self.pieces, origin)
        pieces = (map_file.columns(piece, origin, stored) for piece in self.pieces)
        ply.write_ply_pieces(path, stored.count, pieces)


def refine(
    dataset: Dataset,
    config: Config | None = None,
    *,
    reference: Reference | None = None,
    store: Store | None = None,
    progress: Progress = silent,
) -> Result:
    """The refined recording, made in this process.

    reference: poses to compare with, which decide nothing
    store: where finished stages are kept and looked for; None: in memory
    """
    config = config or Config()
    work = pipeline.refine(dataset, config, reference)
    # as the command does: with more, BLAS sums in another order, and its threads and numba's slow each other down
    with threadpool_limits(1, "blas"):
        store = plan.run(work, {} if store is None else store, progress)
    return collect(dataset, config, work, store)


def collect(dataset: Dataset, config: Config, work: Plan, store: Store) -> Result:
    """The result of a plan that was run over the store."""
    keys = {step.name: key for key, step in work.steps.items()}
    accepted = store[keys["visual-gate"]]
    facts = {"schema": 1, **store[keys["facts"]], "config": settings.to_dict(config)}
    facts["dataset"] = {"path": dataset.root, **facts["dataset"]}
    return Result(
        dataset=dataset,
        config=config,
        world_from_scan=accepted.world_from_scan,
        world_from_camera=accepted.world_from_camera,
        relative_exposure=np.exp(accepted.log_exposure),
        pieces=MapPieces(
            store, tuple(key for name, key in keys.items() if name == "map" or name.startswith("map-"))
        ),
        pictures=store[keys["pictures"]],
        report=facts,
        camera=accepted.camera,
        radiometry=accepted.radiometry,
    )


def with_run(result: Result, stages: Sequence[Any], versions: dict[str, str], name: str = "") -> Result:
    """The result with what its runner knows: a record per stage, the versions of the software, the recording's name.

    name: what the report calls the recording; empty: as its folder
    """
    records = [asdict(stage) for stage in stages]
    dataset = ({"name": name} if name else {}) | result.report["dataset"]
    return replace(
        result, report={**result.report, "dataset": dataset, "versions": versions, "stages": records}
    )

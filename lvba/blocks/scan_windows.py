"""Windows of a recording's scans, thinned, that tell what all scans share."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lvba.arrays import Poses
from lvba.dataset import Dataset, Scan
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment
from lvba.lidar.bundle_adjustment import Aligned
from lvba.lidar.config import LidarConfig
from lvba.lidar.range_errors import RangeErrors
from lvba.loop_closure import rough_poses
from lvba.parallel import in_order

_CORE, _MARGIN, SAMPLED = 24, 4, 2
"""Scans of a window, those on either side that help to solve it, and windows that tell what all scans share."""
_PROBE, _PROBE_STEP_S = 14, 0.4
"""Scans of a window that tells whether there is anything at all, and about the time between them."""
_MOST_POINTS, _PROBE_POINTS = 30_000, 6_000
"""Of a scan, to measure with."""


def cores(count: int) -> list[tuple[int, int]]:
    """Of windows that share all of so many scans, half-open."""
    pieces = max(1, round(count / _CORE))
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return list(pairwise(bounds))


def probes(dataset: Dataset) -> list["Window"]:
    """Few scans about some places of a recording; one window where these are the same, for they tell no more twice.

    They begin at the rough poses, whatever surfaces say: a closer look does not, and asking surfaces takes half as long
    as all that clean probes are for.
    """
    places = (np.arange(SAMPLED) + 1) / (SAMPLED + 1)
    windows = {tuple(numbers.tolist()): numbers for numbers in (_about(dataset, place) for place in places)}
    parts = [(each, slice(0, len(each))) for each in windows.values()]
    return _windows(dataset, parts, _PROBE_POINTS, None)


def sampled(dataset: Dataset, config: LidarConfig) -> list["Window"]:
    """Some of the windows that share all scans."""
    every = cores(len(dataset.scan_paths))
    chosen = np.unique(np.linspace(0, len(every) - 1, SAMPLED + 2)[1:-1].astype(int))
    parts = [_with_margin(dataset, every[number]) for number in chosen]
    return _windows(dataset, parts, _MOST_POINTS, config)


@dataclass(frozen=True)
class Window:
    """Some scans of a recording, thinned.

    numbers: (n,), ascending; core: those that no other window has, in numbers
    begin: (n, 4, 4) float64, the rough poses, or, where surfaces contradict these, poses that surfaces agree with
    """

    numbers: np.ndarray
    core: slice
    scans: list[Scan]
    begin: np.ndarray

    @staticmethod
    def of(dataset: Dataset, core: tuple[int, int], config: LidarConfig) -> "Window":
        """Successive scans with a margin on either side."""
        return _windows(dataset, [_with_margin(dataset, core)], _MOST_POINTS, config)[0]

    @property
    def own(self) -> tuple[int, int]:
        """The scans that no other window has, half-open."""
        own = self.numbers[self.core]
        return int(own[0]), int(own[-1]) + 1

    @property
    def intensity(self) -> np.ndarray | None:
        """(M,) float32, of the points of all its scans; None where one of these has none."""
        known = [scan.intensity for scan in self.scans if scan.intensity is not None]
        return np.concatenate(known) if known and len(known) == len(self.scans) else None

    def every(self, step: int) -> "Window":
        """The window with each step-th point of every scan."""
        return replace(self, scans=[scan.of_points(np.arange(0, len(scan), step)) for scan in self.scans])

    def corrected(self, ranges: RangeErrors | None) -> "Window":
        """The window with its points where they belong."""
        if ranges is None or not ranges.corrected:
            return self
        scans = [
            replace(scan, points=ranges.points(scan.points, intensity=scan.intensity)) for scan in self.scans
        ]
        return replace(self, scans=scans)

    def refined(
        self, dataset: Dataset, points: list[np.ndarray], config: LidarConfig, start: Poses | None = None
    ) -> Aligned | None:
        """Poses and planes by points (N, 3) m of each scan; None where planes do not tell.

        start: (n, 4, 4), of its scans, by points that were corrected otherwise
        """
        try:
            return bundle_adjustment.align(
                points,
                self.begin,
                start,
                sensor_position=dataset.sensor_position_scan,
                config=config,
            )
        except DegenerateProblemError:
            return None


def _with_margin(dataset: Dataset, core: tuple[int, int]) -> tuple[np.ndarray, slice]:
    """Numbers of the scans of a window, and of these the core."""
    numbers = np.arange(max(core[0] - _MARGIN, 0), min(core[1] + _MARGIN, len(dataset.scan_paths)))
    return numbers, slice(core[0] - int(numbers[0]), core[1] - int(numbers[0]))


def _about(dataset: Dataset, place: float) -> np.ndarray:
    """Numbers of few scans about a place, 0 to 1, of the recording."""
    count = len(dataset.scan_paths)
    interval = float(np.median(np.diff(dataset.scans.times))) if count > 1 else _PROBE_STEP_S
    step = int(np.clip(round(_PROBE_STEP_S / max(interval, 1e-3)), 1, max(1, count // _PROBE)))
    first = round(place * max(count - _PROBE * step, 0))
    return np.arange(first, min(first + _PROBE * step, count), step)


def _windows(
    dataset: Dataset, parts: list[tuple[np.ndarray, slice]], most: int, config: LidarConfig | None
) -> list[Window]:
    """Windows of such numbers and cores; a scan that several have is read once.

    config: None: they begin at the rough poses
    """
    numbers = np.unique(np.concatenate([each for each, _ in parts])).tolist()
    scans = dict(zip(numbers, _thinned(dataset, numbers, most), strict=True))
    windows = []
    for each, core in parts:
        own = [scans[number] for number in each.tolist()]
        windows.append(Window(each, core, own, _begin(dataset, each, own, config)))
    return windows


def _begin(
    dataset: Dataset, numbers: np.ndarray, scans: list[Scan], config: LidarConfig | None
) -> np.ndarray:
    """(n, 4, 4), as `Window.begin`: beside a jump of a meter that stays, a window would tell of errors and of motion that
    are none."""
    rough, sensor = dataset.scans.world_from_sensor[numbers], dataset.sensor_position_scan
    if config is None:
        return np.asarray(rough)
    points = [scan.points for scan in scans]
    surfels = rough_poses.surfels_of(points, sensor)
    start = rough_poses.start_if_contradicted(points, surfels, rough, sensor_position=sensor, config=config)
    return np.asarray(rough if start is None else start.world_from_scan)


def _thinned(dataset: Dataset, numbers: list[int], most: int) -> list[Scan]:
    """Some scans with so many points at most."""

    def load(number: int) -> Scan:
        scan = recordings.load_scan(dataset, number)
        if len(scan) <= most:
            return scan
        return scan.of_points(np.sort(np.random.default_rng(number).permutation(len(scan))[:most]))

    return list(in_order(load, numbers))

"""How each scan of a recording moved while it was measured, where that was left in its points.

Each window of successive scans tells of its own, so that parts of a long recording are measured by themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba.blocks import motion_left, scan_windows
from lvba.blocks.moving_windows import MovingWindows
from lvba.blocks.scan_windows import Window
from lvba.dataset import Dataset
from lvba.lidar import path_motion, scan_motion
from lvba.lidar.config import LidarConfig
from lvba.lidar.scan_errors import ScanErrors
from lvba.progress import Progress, silent

_TURNS = 3
"""Times that what is left of each scan's own motion is looked for."""
_SAME = 2e-3
"""rad/s and m/s: deviations that change by less are as they were."""
_PLAUSIBLE = 5.0
"""Times as far as scans are from the path of the others that deviations may be: cabinets told 10 and 27 times as much,
which was wrong, a loop as much, which was right."""
_AS_NEAR = 1.01
"""Times as far as before that points may be from planes: so much comes of which planes are seen."""


@dataclass(frozen=True)
class ScanMotions:
    """Of successive scans: by what their points are moved.

    motion, acceleration: (n, 6) float64, rad/s and m/s, rad/s^2 and m/s^2; pose_covariance: (n, 6, 6); all as
    `scan_motion.MotionLeft` has them
    """

    motion: np.ndarray
    acceleration: np.ndarray
    pose_covariance: np.ndarray


def measure(
    dataset: Dataset,
    scans: tuple[int, int],
    shared: ScanErrors | None,
    config: LidarConfig,
    progress: Progress = silent,
) -> ScanMotions | None:
    """Of the windows that begin in a half-open range of a recording's scans; None: no motion is taken out.

    shared: what all scans of the recording have in common
    Raises InputError: a scan cannot be read.
    """
    motion = None if shared is None else shared.motion
    if shared is None or motion is None or motion.clock is None or not motion_left.is_sure(motion):
        return None
    measurement = _Measurement(MovingWindows(dataset, motion.clock, config), motion.fractions)
    windows = [each for each in scan_windows.cores(len(dataset.scan_paths)) if scans[0] <= each[0] < scans[1]]
    measured = [_no_motions(0)]
    for number, core in enumerate(windows):
        progress("motion during scans", number, len(windows))
        window = Window.of(dataset, core, config).corrected(shared.ranges)
        measured.append(measurement.of(window))
    return _joined(measured)


def joined(shared: ScanErrors | None, motions: Sequence[ScanMotions | None]) -> ScanErrors | None:
    """What is wrong with the scans of a recording, by the motions of all of them, in order."""
    known = [each for each in motions if each is not None]
    if shared is None or shared.motion is None or not known:
        return shared
    whole = _joined(known)
    motion = replace(
        shared.motion,
        motion=whole.motion,
        acceleration=whole.acceleration,
        pose_covariance=whole.pose_covariance,
    )
    return ScanErrors(shared.ranges, motion)


def _no_motions(count: int) -> ScanMotions:
    return ScanMotions(np.zeros((count, 6)), np.zeros((count, 6)), np.zeros((count, 6, 6)))


def _joined(motions: Sequence[ScanMotions]) -> ScanMotions:
    return ScanMotions(
        np.concatenate([each.motion for each in motions]),
        np.concatenate([each.acceleration for each in motions]),
        np.concatenate([each.pose_covariance for each in motions]),
    )


@dataclass(frozen=True)
class _Measurement:
    """Finds poses, planes and motions of windows in turn. fractions: (3,), of `scan_motion.motions`"""

    moving: MovingWindows
    fractions: np.ndarray

    def of(self, window: Window) -> ScanMotions:
        """The motion of the path between scans, and what each scan's own points tell beside it.

        These tell much where scans are further apart than the sensor takes to change its motion.
        window: its points are where errors of the sensor's ranges put them
        """
        path, inside = self._of_path(window), window.core
        deviation, covariance = self._deviations(window, path)
        motion, acceleration = path + deviation[:, :6], 2.0 / self.moving.clock.sweep * deviation[:, 6:]
        # digits that sums in another order would not give are left out
        return ScanMotions(np.round(motion[inside], 7), np.round(acceleration[inside], 6), covariance[inside])

    def _of_path(self, window: Window) -> np.ndarray:
        """(n, 6), rad/s and m/s: what is left of the motion of the path through the scans of a window."""
        first, rough = self.moving.first_twists(window), self.moving.rough_twists(window)
        solved = self.moving.solved(window, scan_motion.left(self.fractions, first, rough))
        own = first if solved is None else self.moving.twists(window, solved.result.world_from_scan)
        return scan_motion.left(self.fractions, own, rough)

    def _wider(self, window: Window) -> np.ndarray:
        """(n, 2) rad/s and m/s, as of `scan_motion.most_likely`: of the first and the last scan of the recording."""
        wider, ends = np.zeros((len(window.numbers), 2)), (0, len(self.moving.dataset.scan_paths) - 1)
        if not np.isin(ends, window.numbers).any():
            return wider
        times = self.moving.dataset.scans.times[window.numbers]
        for end, off in zip(
            ends, path_motion.beyond_ends(times, self.moving.latest(window), self.moving.clock), strict=True
        ):
            wider[window.numbers == end] = np.abs(self.fractions).max() * off
        return wider

    def _deviations(self, window: Window, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Deviations (n, 12) of a window's scans from a motion (n, 6), rad/s and m/s, and what their uncertainty adds to
        the covariances of the poses, (n, 6, 6).

        They are looked for with those found so far taken out, for planes are sharper then. How much planes tell of
        deviations says nothing of whether they are right: where poses are off, planes are, too, and a window told more
        and more of up to 38 m/s. So they are as large as the path from scan to scan allows, but for the first and last
        scan, of which it tells less; and points stay as near to planes.
        """
        sweep, scale, least, most = self.moving.clock.sweep, None, np.inf, self._most(window)
        deviation, covariance = np.zeros((len(path), 12)), np.zeros((len(path), 6, 6))
        used, wider = (deviation, covariance), self._wider(window)
        inner = ~wider.any(axis=1)
        for _ in range(_TURNS):
            motion, acceleration = path + deviation[:, :6], 2.0 / sweep * deviation[:, 6:]
            solved = self.moving.solved(window, motion, acceleration)
            if solved is None:
                break
            view = self.moving.view(solved)
            scale = view.thickness if scale is None else scale
            if not (away := view.away(scale)) < _AS_NEAR * least:
                break
            least, used = min(away, least), (deviation, covariance)
            seen = scan_motion.deviations(view, solved.tau, sweep).beside(deviation)
            deviation, covariance = scan_motion.most_likely(seen, wider)
            if (path_motion.sizes(deviation[inner]) > most).any():
                deviation[inner], covariance[inner] = used[0][inner], used[1][inner]
            if np.abs(deviation - used[0]).max() < _SAME:
                break
        return used

    def _most(self, window: Window) -> np.ndarray:
        """(4,) rad/s, m/s, and what these grow by over a sweep: sizes that deviations of a window's scans may have."""
        times = self.moving.dataset.scans.times[window.numbers]
        sizes = [
            path_motion.unpredicted(times, poses, self.moving.clock)
            for poses in (window.begin, self.moving.latest(window))
        ]
        return np.asarray(_PLAUSIBLE * np.min(sizes, axis=0))

"""What is systematically wrong with the scans of a recording: errors of the range sensor, then motion left in scans."""

from functools import cache, partial

from lvba.blocks import motion_left, range_errors, scan_motions, scan_windows
from lvba.dataset import Dataset
from lvba.lidar.config import LidarConfig
from lvba.lidar.scan_errors import ScanErrors
from lvba.progress import Progress, silent


def measure(
    dataset: Dataset, config: LidarConfig, enabled: bool = True, progress: Progress = silent
) -> ScanErrors | None:
    """Of a whole recording; None where nothing is measured.

    enabled: False: scan poses are not refined, and nothing is measured
    Raises InputError: a scan cannot be read.
    """
    shared = measure_shared(dataset, config, enabled, progress)
    everything = (0, len(dataset.scan_paths))
    return scan_motions.joined(shared, [scan_motions.measure(dataset, everything, shared, config, progress)])


def measure_shared(
    dataset: Dataset, config: LidarConfig, enabled: bool = True, progress: Progress = silent
) -> ScanErrors | None:
    """What all scans of a recording have in common, with which part of their motion is left and no motions.

    enabled: as of `measure`
    Raises InputError: a scan cannot be read.
    """
    if not enabled:
        return None
    probes = scan_windows.probes(dataset)
    sampled = cache(partial(scan_windows.sampled, dataset, config))  # read, and laid out, once for both
    ranges = range_errors.measure(dataset, probes, sampled, config, progress)
    return ScanErrors(ranges, motion_left.measure(dataset, probes, sampled, config, ranges, progress))

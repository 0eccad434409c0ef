"""Cutting a recording into parts: everything in exactly one core, overlaps as asked for, limits said with numbers."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from lvba.blocks import split
from lvba.blocks.split import Load, Part, SplitConfig, memory_bytes, parts, regions, subset
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.errors import InputError
from lvba.trajectory import Trajectory

LOAD = Load(30_000, 640 * 480)


def recording(scans=100, images=150, step=1.0):
    poses = np.broadcast_to(np.eye(4), (scans, 4, 4)).copy()
    poses[:, 0, 3] = step * np.arange(scans)
    stamps = np.linspace(0.2, 0.5 * scans - 0.3, images)
    cameras = np.broadcast_to(np.eye(4), (images, 4, 4)).copy()
    return Dataset(
        root="street",
        scan_paths=tuple(f"{k}.pcd" for k in range(scans)),
        scans=Trajectory(0.5 * np.arange(scans), poses),
        image_paths=tuple(f"{k}.png" for k in range(images)),
        images=Trajectory(stamps, cameras),
        cameras=(RigCamera(Camera(640, 480, 500.0, 500.0, 320.0, 240.0), np.eye(4)),),
        digest="d",
    )


WAYS = {
    "length": SplitConfig(by="length", size=25.0),
    "time": SplitConfig(by="time", size=12.0),
    "count": SplitConfig(by="count", size=20),
    "own": SplitConfig(starts=(8.0, 31.5)),
    "memory": SplitConfig(by="memory", memory_gb=0.7),
    "overlap": SplitConfig(by="length", size=25.0, overlap=6.0),
}


@pytest.mark.parametrize("config", WAYS.values(), ids=WAYS.keys())
def test_every_frame_is_in_one_core_and_neighbors_overlap(config):
    dataset = recording()
    found = parts(dataset, config, LOAD)
    assert len(found) > 1
    assert np.concatenate([np.arange(*part.core_scans) for part in found]).tolist() == list(range(100))
    assert np.concatenate([np.arange(*part.core_images) for part in found]).tolist() == list(range(150))
    for part in found:
        assert part.scans[0] <= part.core_scans[0] < part.core_scans[1] <= part.scans[1]
        assert part.images[0] <= part.core_images[0] < part.core_images[1] <= part.images[1]
        assert part.scan_numbers[part.core_of_scans].tolist() == list(range(*part.core_scans))
    for left, right in pairwise(found):
        assert left.scans[1] - right.scans[0] >= 12


def test_the_overlap_reaches_as_far_as_asked_on_either_side():
    found = parts(recording(), SplitConfig(by="length", size=25.0, overlap=6.0), LOAD)
    middle = found[1]
    assert (middle.core_scans[0] - middle.scans[0], middle.scans[1] - middle.core_scans[1]) == (6, 6)


def test_what_fits_into_memory_is_not_cut_and_what_does_not_fits_in_its_parts():
    dataset = recording()
    assert len(parts(dataset, SplitConfig(), LOAD)) == 1
    found = parts(dataset, SplitConfig(memory_gb=0.7), LOAD)
    needs = [memory_bytes(LOAD, np.ptp(part.scans), np.ptp(part.images)) for part in found]
    assert max(needs) <= 0.7e9 * 1.02 < memory_bytes(LOAD, 100, 150)
    assert len(parts(dataset, SplitConfig(by="none"), LOAD)) == 1


def test_parts_own_space_together_where_their_points_are_few():
    dataset = recording()
    few = parts(dataset, SplitConfig(by="count", size=25), LOAD)
    assert regions(few, LOAD) == tuple(few)
    many = [
        Part(
            n,
            (max(10 * n - 5, 0), 10 * n + 15),
            (10 * n, 10 * n + 10),
            (15 * n, 15 * n + 15),
            (15 * n, 15 * n + 15),
        )
        for n in range(100)
    ]
    thin, dense, denser = (regions(many, Load(points, 0)) for points in (3_000, 60_000, 1_000_000))
    assert [len(found) for found in (thin, dense, denser)] == [16, 30, 100]
    for found in (thin, dense):
        assert [region.number for region in found] == list(range(len(found)))
        bounds = [region.core_scans for region in found]
        assert [end for _, end in bounds[:-1]] == [begin for begin, _ in bounds[1:]]
        assert (bounds[0][0], bounds[-1][1]) == (0, 1000)
        assert found[1].scans == (found[1].core_scans[0] - 5, found[1].core_scans[1] + 5)
        assert found[-1].core_images[1] == 1500
    assert denser == tuple(many)


def test_dense_scans_are_solved_with_fewer_points_each():
    """About as many whatever the sensor; the memory of a part follows these, and that of its map all points."""
    loads = {points: Load(points, 640 * 480) for points in (30_000, 131_072, 160_000, 290_000, 2_000_000)}
    assert [load.every for load in loads.values()] == [1, 1, 2, 3, 20]
    assert all(0.5 * split.ENOUGH_POINTS < load.solved_per_scan < 1.5 * split.ENOUGH_POINTS
               for load in list(loads.values())[1:])  # fmt: skip
    usual, dense = (split.memory_bytes(loads[points], 97, 0) for points in (30_000, 290_000))
    pairs = split.BYTES_PER_PAIR_OF_SCANS * 97**2
    assert usual == split.BASE_BYTES + split.BYTES_PER_POINT * 97 * 30_000 + pairs
    assert split.BASE_BYTES + split.BYTES_PER_POINT * 97 * 96_667 < dense < 3.2e9
    assert split.memory_bytes(loads[2_000_000], 97, 0) == split.map_bytes(loads[2_000_000], 97) > 13e9


def test_too_short_parts_and_too_little_overlap_are_errors_with_the_numbers():
    with pytest.raises(InputError, match=r"would hold 5 scans of its own; at least 10"):
        parts(recording(), SplitConfig(by="count", size=5), LOAD)
    with pytest.raises(InputError, match=r"would hold 4 scans of its own; at least 10"):
        parts(recording(), SplitConfig(by="time", size=2.0), LOAD)
    with pytest.raises(InputError, match=r"would share 2 scans with an overlap of 1; at least 3"):
        parts(recording(), SplitConfig(by="count", size=20, overlap=1), LOAD)
    with pytest.raises(InputError, match=r"0.5 GB hold not even 30 scans"):
        parts(recording(), SplitConfig(memory_gb=0.5), Load(3_000_000, 640 * 480))


def paused(*groups, images=150):
    """A recording of groups of scans, half a second from scan to scan, and 600 s from group to group."""
    dataset = recording(sum(groups), images)
    times = np.concatenate(
        [0.5 * np.arange(n) + start for n, start in zip(groups, _starts(groups), strict=True)]
    )
    stamps = np.interp(np.linspace(0, len(times) - 1, images), np.arange(len(times)), times)
    return dataclasses.replace(
        dataset,
        scans=dataclasses.replace(dataset.scans, times=times),
        images=dataclasses.replace(dataset.images, times=stamps),
    )


def _starts(groups):
    return np.concatenate([[0.0], np.cumsum([0.5 * (n - 1) + 600.0 for n in groups[:-1]])])


@pytest.mark.parametrize("size", [10.0, 20.0, 60.0, 250.0])
@pytest.mark.parametrize("groups", [(120, 120), (137, 83), (125, 4, 200)])
def test_recordings_with_pauses_are_split_by_time(groups, size):
    """Before: `part 3 of 33 would hold 0 scans`."""
    dataset = paused(*groups)
    found = parts(dataset, SplitConfig(by="time", size=size), LOAD)
    assert np.concatenate([np.arange(*part.core_scans) for part in found]).tolist() == list(
        range(sum(groups))
    )
    assert np.concatenate([np.arange(*part.core_images) for part in found]).tolist() == list(range(150))
    sizes = np.array([np.diff(part.core_scans)[0] for part in found])
    assert sizes.min() >= split.FEWEST_SCANS
    assert sizes.max() <= 2 * size / 0.5 + split.FEWEST_SCANS
    for left, right in pairwise(found):
        assert left.scans[1] - right.scans[0] >= 12
    if size < 60.0:
        held = max(np.diff(part.scans)[0] for part in found)
        assert held <= 2 * sizes.max() + 20, "a pause beside a part does not make it reach far back"


def test_too_few_scans_between_pauses_join_the_nearer_part():
    dataset = paused(100, 5, 100)
    times = dataset.scans.times.copy()
    times[105:] -= 500.0
    dataset = dataclasses.replace(dataset, scans=dataclasses.replace(dataset.scans, times=times))
    found = parts(dataset, SplitConfig(by="time", size=60.0), LOAD)
    assert 105 not in [part.core_scans[0] for part in found]
    assert 100 in [part.core_scans[0] for part in found]


@pytest.mark.parametrize(
    "wrong",
    [{"by": "weight"}, {"by": "count"}, {"overlap": -1.0}, {"memory_gb": 0.1}, {"starts": (5.0, 4.0)}],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SplitConfig(**wrong)


@pytest.mark.parametrize(("by", "size"), [("time", 1e-300), ("length", 1e-6), ("count", 0.5), ("time", 0.3)])
def test_more_parts_than_scans_are_refused_before_they_are_made(by, size):
    with pytest.raises(InputError, match=rf"split.size: parts of {size:g} .* more than the 100 scans"):
        parts(recording(), SplitConfig(by=by, size=size), LOAD)


@pytest.mark.parametrize(
    "starts", [(float("nan"),), (5.0, float("nan")), (float("inf"),), (5.0, 5.0), (0.0,)]
)
def test_starts_are_finite_and_ascending(starts):
    with pytest.raises(ValueError, match="must be finite, ascending and above 0"):
        SplitConfig(starts=starts)


def test_a_subset_is_a_recording_of_its_own():
    whole = recording()
    some = subset(whole, np.arange(10, 20), np.arange(5, 25))
    assert some.scan_paths == whole.scan_paths[10:20]
    assert np.array_equal(some.images.times, whole.images.times[5:25])
    assert some.digest not in ("", whole.digest)
    assert some.digest != subset(whole, np.arange(10, 20), np.arange(5, 24)).digest

"""Frames whose stamps are out of order: what they cost, and that it is told."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest

from lvba.io.dataset import open_dataset
from lvba.sources.importing import own_odometry
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions
from lvba.sources.importing.stamp_order import in_order
from lvba.sources.source import RawImage, RawScan

pytestmark = pytest.mark.usefixtures("one_pair")
SECOND = 1_000_000_000


def most_that_grow(stamps):
    """By trying all parts of a few stamps."""
    for count in range(len(stamps), 0, -1):
        for numbers in combinations(range(len(stamps)), count):
            if all(stamps[one] < stamps[other] for one, other in pairwise(numbers)):
                return count
    return 0


def test_as_many_frames_as_can_be_are_in_order():
    rng = np.random.default_rng(0)
    for _ in range(200):
        stamps = rng.integers(0, 8, rng.integers(0, 9))
        kept = in_order(stamps)
        assert (np.diff(stamps[kept]) > 0).all()
        assert np.count_nonzero(kept) == most_that_grow(stamps)


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([1, 2, 3], [1, 2, 3]),
        ([1, 90, 2, 3, 4], [1, 2, 3, 4]),
        ([1, 2, 3, -90, 4], [1, 2, 3, 4]),
        ([1, 3, 2, 4], [1, 3, 4]),
        ([1, 1, 2], [1, 2]),
    ],
)
def test_a_stamp_that_is_too_late_costs_its_own_frame(stamps, kept):
    stamps = np.array(stamps)
    assert stamps[in_order(stamps)].tolist() == kept


def late(source, kind, number, by):
    """The source with the stamp of one frame of a kind later by so many ns."""
    count, items = 0, []
    for name, record in source.items:
        if isinstance(record, kind):
            count += 1
            record = replace(record, stamp=record.stamp + by) if count == number else record
        items.append((name, record))
    return replace(source, items=tuple(items))


@pytest.mark.parametrize("kind", [RawScan, RawImage])
@pytest.mark.parametrize("by", [3600 * SECOND, SECOND // 2 + 3_000_000])
def test_one_stamp_that_is_too_late_loses_one_frame(tmp_path, small_source, kind, by):
    import_source(small_source, tmp_path / "whole")
    whole = open_dataset(tmp_path / "whole")
    report = import_source(late(small_source, kind, 4, by), tmp_path / "out")
    dataset = open_dataset(tmp_path / "out")
    counts = [
        len(whole.scan_paths) - len(dataset.scan_paths),
        len(whole.image_paths) - len(dataset.image_paths),
    ]
    assert counts == ([1, 0] if kind is RawScan else [0, 1])
    what = "scans" if kind is RawScan else "images"
    assert f"1 {what} whose stamps are out of order left out" in report.facts["losses"]


def test_a_scan_with_a_stamp_that_is_too_late_is_not_registered(tmp_path, small_source, monkeypatch):
    seen = []

    class EnoughError(Exception):
        pass

    def estimate(sweeps, *_):
        seen.extend(sweep.time for sweep in sweeps)
        raise EnoughError

    monkeypatch.setattr(own_odometry.estimating, "estimate", estimate)
    with pytest.raises(EnoughError):
        import_source(
            late(small_source, RawScan, 4, 3600 * SECOND), tmp_path / "out", ImportOptions(odometry="auto")
        )
    assert len(seen) == sum(isinstance(record, RawScan) for _, record in small_source.items) - 1
    assert (np.diff(seen) > 0).all()

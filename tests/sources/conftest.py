"""What tests of small sources share: two seconds of a courtyard, and imports that look at one pair of scans."""

import pytest
from changed_sources import SMALL

from lvba.simulate import raw
from lvba.sources.importing import readings


@pytest.fixture(scope="module")
def small_truth():
    return raw.measure("courtyard", seconds=2.0, sensors=SMALL)


@pytest.fixture(scope="module")
def small_source(small_truth):
    return raw.written(small_truth, sensors=SMALL)


@pytest.fixture
def one_pair(monkeypatch):
    """Nothing is decided by the data."""
    monkeypatch.setattr(readings, "MOST_PAIRS", 1)

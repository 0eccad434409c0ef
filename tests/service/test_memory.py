"""What is said, and refused, of memory before a run begins."""

import argparse
import io
from dataclasses import replace

import pytest

from lvba.blocks import split, survey
from lvba.blocks.split import SplitConfig
from lvba.errors import InputError
from lvba.io.dataset import open_dataset
from lvba.pipeline import Config
from service.cli import clusters, memory_estimate
from service.cli.progress import Display


def asked(**options):
    given = {"workers": 2, "scheduler": None, "memory_limit": None, "quiet": False, **options}
    given |= dict.fromkeys(("tls_ca", "tls_cert", "tls_key"))
    return argparse.Namespace(**given)


@pytest.fixture
def dataset(recording):
    return open_dataset(recording)


def said(dataset, parts=None, **options):
    stream = io.StringIO()
    config = Config() if parts is None else replace(Config(), split=parts)
    display = Display(stream, quiet=options.get("quiet", False))
    memory_estimate.announce(asked(**options), dataset, config, display)
    return stream.getvalue()


def test_one_line_says_what_a_part_takes_and_of_what(dataset):
    load = survey.load_of(dataset)
    whole = split.memory_bytes(load, len(dataset.scans), len(dataset.image_paths)) / 1e9
    assert said(dataset, memory_limit="3GB") == f"memory: about {whole:.1f} GB, of 3.0 GB for each worker\n"
    assert said(dataset, workers=None).startswith(f"memory: about {whole:.1f} GB, of ")
    assert "limit is their own" in said(dataset, workers=None, scheduler="tcp://h:1")
    assert said(dataset, quiet=True) == ""


def test_parts_are_counted(dataset):
    parts = SplitConfig(by="none", starts=(float(dataset.scans.times[10] - dataset.scans.times[0]),))
    with pytest.raises(InputError, match="at least 10"):
        said(dataset, parts)  # the second would hold six scans
    assert "memory for each of 2 parts: about " in said(twice(dataset), parts)


def twice(dataset):
    """The recording with each scan two times, so that it is long enough for two parts."""
    numbers = sorted([*range(len(dataset.scans)), *range(len(dataset.scans))])
    return split.subset(dataset, numbers, list(range(len(dataset.image_paths))))


@pytest.mark.parametrize(("limit", "mend"), [("0.2", "or more$"), ("0.5GB", r"--set split.memory_gb=0.5\)$")])
def test_less_than_a_part_takes_is_refused(dataset, monkeypatch, limit, mend):
    monkeypatch.setattr(split, "BASE_BYTES", 600e6)
    with pytest.raises(
        InputError, match=f"the recording takes about 0.[67]\\d GB; give each worker .*{mend}"
    ):
        said(dataset, memory_limit=limit)


@pytest.mark.parametrize(
    ("text", "found"), [("2", 2e9), ("1.5", 1.5e9), ("2GB", 2e9), ("2 GiB", 2 << 30), ("800MB", 8e8)]
)
def test_amounts(text, found):
    assert clusters.memory_bytes(asked(memory_limit=text)) == found


@pytest.mark.parametrize("text", ["much", "", "-1", "0", "5MB", "nan"])
def test_no_amount(text):
    with pytest.raises(InputError, match="write for example 8GB"):
        clusters.memory_bytes(asked(memory_limit=text))


def test_a_limit_is_for_own_workers():
    with pytest.raises(InputError, match="give --workers"):
        clusters.check(asked(workers=None, memory_limit="2"))

"""`lvba simulate --bag`: what it writes is read again, with the truth beside it."""

import numpy as np
from test_bad_use import assert_one_line

from lvba.io import tum
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm
from lvba.sources.opening import open_source
from lvba.sources.source import Kind
from service.cli import main

SMALL = ("--frames", 10, "--points", 500, "--width", 64, "--height", 48)


def test_choices_are_those_of_the_writer():
    assert list(BagForm) == list(main.BAG_FORMS)
    assert list(PointLayout) == list(main.BAG_LAYOUTS)


def test_a_simulated_bag_has_all_sensors_and_the_truth(lvba, tmp_path):
    out = tmp_path / "walk"
    lvba("simulate", "courtyard", "--out", out, "--bag", "mcap", "--bag-points", "velodyne", *SMALL)
    source = open_source(out)
    kinds = {stream.kind: stream for stream in source.describe().streams}
    assert {Kind.SCANS, Kind.IMAGES, Kind.POSES, Kind.IMU, Kind.CAMERA_INFO, Kind.TRANSFORMS} <= kinds.keys()
    stamps = [record.stamp * 1e-9 for _, record in source.records({kinds[Kind.SCANS].name})]
    truth = tum.read_trajectory(f"{out}.truth.txt")
    assert len(truth.times) == len(stamps) == 10
    assert (
        np.abs(np.array(stamps) - truth.times - 0.1).max() < 0.002
    )  # Velodyne's stamp is the end of the sweep
    assert_one_line(
        lvba("simulate", "courtyard", "--out", out, "--bag", "mcap", *SMALL, code=2), "walk", "exists"
    )


def test_options_that_do_not_go_with_bags_are_refused(lvba, tmp_path):
    done = lvba("simulate", "courtyard", "--out", tmp_path / "a", "--bag", "mcap", "--vignetting", code=2)
    assert_one_line(done, "--vignetting: does not go with --bag")

"""Bags so small that an import and a run of one take seconds."""

from lvba.simulate import raw
from lvba.simulate.raw import Sensors
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag


def make_bags(folder):
    """walk.bag, and walk_mcap/ and walk_sqlite3/ with their metadata: the same short walk in a courtyard, 16 scans."""
    folder.mkdir(parents=True, exist_ok=True)
    sensors = Sensors(points=1500, width=96, height=72, image_hz=5.0)
    source, _ = raw.simulate_raw("courtyard", seconds=1.6, sensors=sensors)
    for form, name in (
        (BagForm.ROS1, "walk.bag"),
        (BagForm.MCAP, "walk_mcap"),
        (BagForm.SQLITE3, "walk_sqlite3"),
    ):
        write_bag(source, folder / name, form, PointLayout.VELODYNE)

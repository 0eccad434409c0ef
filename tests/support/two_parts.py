"""A short street in two parts."""

from lvba import simulate

SPLIT = {"by": "count", "size": 10, "overlap": 5}
PARTS = [word for name, value in SPLIT.items() for word in ("--set", f"split.{name}={value}")]


def make_street(folder):
    # with fewer points, surfaces are so few that they contradict the rough poses, and a run takes twice as long
    sizes = {"width": 160, "height": 120, "points_per_scan": 3000}
    simulate.simulate("street", folder, frames=20, scans=20, length=15.0, seed=5, **sizes)
    return folder

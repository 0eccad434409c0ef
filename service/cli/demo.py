"""`make demo`: a small recording with known truth, refined, and compared with the truth."""

import shutil
import sys
from pathlib import Path

from service.cli import main as command_line
from service.system.threads import limit_threads


def main(folder: Path) -> int:
    """Exit code of the run that ends the demo."""
    limit_threads(None)
    recording = folder / "recording"
    if not recording.exists():
        _simulate(recording)
    truth = str(recording / "reference")
    return command_line.main(["run", str(recording), "--out", str(folder / "result"), "--reference", truth])


def _simulate(recording: Path) -> None:
    from lvba.simulate import simulate
    from service.cli.progress import Display

    display = Display()
    display.stage("simulate a courtyard", 0, 1)
    unfinished = recording.with_name("recording.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    simulate(
        "courtyard",
        unfinished,
        seed=1,
        frames=60,
        scans=60,
        width=480,
        height=360,
        points_per_scan=15_000,
        progress=display.progress,
    )
    display.clear()
    unfinished.rename(recording)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

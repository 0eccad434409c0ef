"""The arguments of `lvba import`."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from lvba import settings
from lvba.sources.importing.options import ImportOptions

IMPORT = """\
Make a recording folder of a bag, or of a folder of another program: scans free of motion distortion, images, poses and
calibration.

What drivers and odometries leave open (what a stamp means, what a pose is of, which way a transform goes) is found from
the data, told, and kept with its evidence in OUT/recording.yaml. Where the data cannot tell, a warning names the option
that decides. The same command continues a stopped import."""

IMPORT_EXAMPLES = """\
examples:
  lvba import walk.bag --out recording
  lvba import walk.mcap --out recording --odometry poses.txt --calibration camchain-imucam.yaml
  lvba import walk.bag --out recording --lidar /livox/lidar --image none --from 20 --to 80
  lvba run walk.bag --out result"""


def add_arguments(command: argparse.ArgumentParser, count: Any) -> None:
    """Of the command. count: type of whole numbers of 1 or more"""
    command.add_argument("source", type=Path, metavar="SOURCE", help="bag, or folder of another program")
    command.add_argument("--out", type=Path, required=True, metavar="RECORDING", help="folder to write")
    add_choices(command, count, command=", or a command with {bag} and {out} that writes a TUM file")


def add_choices(parser: Any, count: Any, *, command: str = "") -> None:
    """What may be chosen of a source (`ImportOptions`). command: what else --odometry may be, for people"""
    for name in ("lidar", "image", "imu"):
        parser.add_argument(f"--{name}", default="", metavar="TOPIC", help=_HELP[name])
    parser.add_argument(
        "--odometry",
        default="",
        metavar="TOPIC|FILE|auto|COMMAND" if command else "TOPIC|FILE|auto",
        help=_HELP["odometry"] + command,
    )
    parser.add_argument(
        "--calibration", nargs="+", action="extend", default=[], metavar="FILE", help=_HELP["calibration"]
    )
    parser.add_argument("--camera", default="", metavar="NAME", help=_HELP["camera"])
    parser.add_argument("--preset", default="", metavar="NAME", help=_HELP["preset"])
    parser.add_argument(
        "--time-convention",
        choices=["begin", "middle", "end", "auto"],
        default="auto",
        help="moment of the sweep that a pose with the stamp of a scan holds at (default: auto, by the data)",
    )
    parser.add_argument(
        "--convention",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="an answer that is not left to the data, see docs/import.md; as pose_of=lidar",
    )
    parser.add_argument("--from", dest="start", type=float, metavar="T", help=f"s: {_HELP['start']}")
    parser.add_argument("--to", dest="stop", type=float, metavar="T", help=f"s: {_HELP['stop']}")
    parser.add_argument("--every", type=count, default=1, metavar="N", help=_HELP["every"])
    parser.add_argument("--rate", type=_rate, default=0.0, metavar="HZ", help=_HELP["rate"])


def _help() -> dict[str, str]:
    """What each field of the options means, without the full stop."""
    known = {each.name: settings.about(each) for each in dataclasses.fields(ImportOptions)}
    texts = {name: about.meaning.rstrip(".") for name, about in known.items() if about is not None}
    return {name: text[0].lower() + text[1:] for name, text in texts.items()}


_HELP = _help()


def _rate(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text} is no number") from None
    if not 0 < number < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return number

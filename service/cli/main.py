"""The command line: `lvba import | run | batch | worker | evaluate | simulate | inspect | view | export` and more.

Nothing heavy is imported before a command runs, so that `lvba --help` answers at once.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NoReturn

from service.cli import stopping
from service.system.threads import limit_blas, limit_threads

_EPILOG = """\
examples:
  lvba simulate courtyard --out demo
  lvba run demo --out result --reference demo/reference
  lvba export result laz --out map.laz

Each command has its own help: lvba run --help"""

_RUN = """\
Refine the scan poses, camera poses and exposures of a recording, and color its map.

OUT gets the result (poses, exposures, map.ply, report.html, report.json, config.yaml) and, in OUT/stages, the
intermediate results. The same command continues a stopped run after its last finished stage. A bag is imported into
OUT/recording first, as `lvba import` does it."""

_RUN_EXAMPLES = """\
examples:
  lvba run recording --out result
  lvba run recording --out result --set visual.levels=2 --set visual.patch=11
  lvba run recording --out result --config settings.yaml --reference truth
  lvba run recording --out result --workers 4
  lvba run recording --out result --scheduler tcp://head:8786 --store s3://bucket/recording

OUT/config.yaml has every setting with its value and meaning, and can be given as --config."""

_BATCH = """\
Refine many recordings, a few at a time, and write one table of their results.

MANIFEST is a YAML list; each entry has `dataset`, and may have `name`, `config`, `set` (a list), `import` (options of
`lvba import`, of a bag), `reference` and `group`. Paths are relative to MANIFEST. Groups take turns, so that a short list
does not wait for a long one. A recording that fails does not stop the others. The same command continues an interrupted
batch."""

_BATCH_EXAMPLES = """\
examples:
  lvba batch recordings.yaml --out results
  lvba batch recordings.yaml --out results --jobs 4 --scheduler tcp://head:8786
  lvba batch recordings.yaml --out results --server http://host:8080

OUT/NAME is the result of a recording, OUT/NAME.log its log; OUT/summary.json and OUT/summary.csv are the table.
Exit code 1: some failed."""

_WORKER = """\
Run steps for the Dask scheduler at ADDRESS until stopped: one at a time, with --threads threads.

Start one on each machine, or several with --threads and --memory-limit. A worker that loses its scheduler waits for
it. Whoever can connect to a scheduler can run code on its workers: use tls:// outside a trusted network."""

_WORKER_EXAMPLES = """\
examples:
  lvba worker tcp://127.0.0.1:8786 --threads 4 --memory-limit 8GB
  lvba worker tls://head:8786 --tls-ca ca.pem --tls-cert node.pem --tls-key node.key"""

_EVALUATE = """\
Evaluate poses and exposures of any method by the figures that `lvba run` reports of its own.

In the report, "rough" is the recording as it is, and "refined" is the recording with the files given here."""

_EVALUATE_EXAMPLES = """\
examples:
  lvba evaluate recording --out judged
  lvba evaluate recording --out judged --lidar-poses other/lidar_poses.txt --image-poses other/image_poses.txt
  lvba evaluate recording --out judged --reference truth"""

_SIMULATE = """\
Simulate a recording of a generated scene; OUT/reference has the true poses and exposures."""

BAG_FORMS = ("ros1", "ros1-lz4", "ros1-bz2", "sqlite3", "mcap", "mcap-zstd")
BAG_LAYOUTS = ("livox-custom-1", "livox-custom-2", "livox-cloud", "ouster", "velodyne", "hesai", "robosense")

_SIMULATE_EXAMPLES = """\
examples:
  lvba simulate courtyard --out yard
  lvba simulate rooms --out rooms --frames 60 --seed 3 --difficulty hard --lidar non_repetitive
  lvba simulate street --out street --length 400 --frames 400 --motion-blur
  lvba simulate block --out block --length 400 --frames 200 --closing 1 2
  lvba simulate courtyard --out walk.bag --bag ros1 --frames 100"""

_INSPECT = """\
Tell what is in a bag (ROS 1, ROS 2, MCAP) or folder: streams with types, counts, rates and clocks, fields of points and
what their times mean, cameras, what is missing, and the command that imports it. Nothing is written."""

_INSPECT_EXAMPLES = """\
examples:
  lvba inspect walk.bag
  lvba inspect rosbag2_2024_05_01 --json"""

_VIEW = """\
Show a result in the browser: the map in 3D, photographs beside the map, figures and files. The server answers this
machine only and writes nothing. The address goes to stdout; Ctrl-C ends it."""

_VIEW_EXAMPLES = """\
examples:
  lvba view result
  lvba view result --port 8090 --no-browser

Without --viewer in the run, the map is first converted in a temporary folder; `lvba export RESULT lod` keeps the
converted files."""

_EXPORT = """\
Write the map or the poses of a result in another format. lod: the map with levels of detail and the pictures of the
viewer, in cloud/ and frames/ of RESULT."""

_EXPORT_EXAMPLES = """\
examples:
  lvba export result laz
  lvba export result laz --crs EPSG:25833+7837 --out yard.laz
  lvba export result colmap --out colmap_model"""


_WARM = """\
Compile the numerical kernels, so that the first run does not wait for it: up to two minutes, once on a machine.

A small made-up recording is refined in a temporary folder. Compiled code is kept beside the program, or in
NUMBA_CACHE_DIR where that is set; where all is there already, nothing is done."""

_WARM_EXAMPLES = """\
examples:
  lvba warm
  NUMBA_CACHE_DIR=/var/cache/lvba lvba warm"""


class Parser(argparse.ArgumentParser):
    """Usage mistakes are one line on stderr, and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command. 0: done; 2: bad input or usage, one line on stderr; 130: Ctrl-C; 1: anything else."""
    limit_blas()
    arguments = parser().parse_args(argv)
    limit_threads(arguments.threads)
    stopping.install()
    try:
        from service.cli import dispatch

        return dispatch.main(arguments)
    except KeyboardInterrupt:
        # so early or so late that nothing is lost
        sys.stderr.write("lvba: stopped\n")
        return stopping.code()


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = Parser(
        prog="lvba",
        description="LiDAR-visual bundle adjustment: from rough odometry poses to a colored map.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"lvba {metadata.version('lvba')}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_import(commands)
    _add_run(commands)
    _add_batch(commands)
    _add_worker(commands)
    _add_evaluate(commands)
    _add_simulate(commands)
    _add_inspect(commands)
    _add_view(commands)
    _add_export(commands)
    _command(commands, "warm", "compile what runs need", _WARM, _WARM_EXAMPLES)
    from service.cli import server_parser  # brings numpy, too

    server_parser.add(commands, _command)
    return top


def _add_import(commands: "argparse._SubParsersAction[Parser]") -> None:
    from service.cli import import_parser  # brings numpy, before which the threads of BLAS are limited

    summary = "make a recording folder from a bag"
    command = _command(commands, "import", summary, import_parser.IMPORT, import_parser.IMPORT_EXAMPLES)
    import_parser.add_arguments(command, _count)


def _add_run(commands: "argparse._SubParsersAction[Parser]") -> None:
    run = _command(commands, "run", "refine a recording", _RUN, _RUN_EXAMPLES)
    _add_recording_and_out(run, "recording folder or bag")
    _add_settings(run)
    run.add_argument("--reference", type=Path, metavar="DIR", help="folder of true poses to compare with")
    run.add_argument(
        "--store", metavar="URL", help="folder or URL of intermediate results (default: OUT/stages)"
    )
    run.add_argument("--redo", metavar="STAGE", help="repeat this stage and all that depend on it")
    run.add_argument(
        "--import",
        dest="import_options",
        type=Path,
        metavar="FILE",
        help="for a bag: options of `lvba import`, YAML, such as `lidar: /points`",
    )
    run.add_argument(
        "--recording",
        type=Path,
        metavar="DIR",
        help="for a bag: recording folder to make (default: OUT/recording)",
    )
    run.add_argument("--name", help="name of the recording in the report (default: its folder)")
    run.add_argument("--events", type=Path, metavar="FILE", help="append events to FILE, as JSON lines")
    run.add_argument("--viewer", action="store_true", help="also write what `lvba export OUT lod` writes")
    _add_cluster(run)


def _add_batch(commands: "argparse._SubParsersAction[Parser]") -> None:
    batch = _command(commands, "batch", "refine many recordings", _BATCH, _BATCH_EXAMPLES)
    batch.add_argument("manifest", type=Path, metavar="MANIFEST", help="YAML list of recordings")
    batch.add_argument(
        "--out", type=Path, required=True, metavar="OUT", help="folder for results and summary"
    )
    batch.add_argument(
        "--jobs", type=_count, default=1, metavar="N", help="recordings at a time (default: 1)"
    )
    batch.add_argument(
        "--store", metavar="URL", help="folder or URL of intermediate results (default: in OUT)"
    )
    from service.cli import server_parser  # brings numpy, too

    server_parser.add_server(batch, asked=False)
    _add_cluster(batch)


def _add_worker(commands: "argparse._SubParsersAction[Parser]") -> None:
    worker = _command(
        commands, "worker", "run steps for the scheduler of a cluster", _WORKER, _WORKER_EXAMPLES
    )
    worker.add_argument("address", metavar="ADDRESS", help="scheduler: tcp://HOST:PORT or tls://HOST:PORT")
    worker.add_argument("--memory-limit", metavar="GB", help="for example 8GB (default: all memory)")
    _add_tls(worker)


def _add_evaluate(commands: "argparse._SubParsersAction[Parser]") -> None:
    evaluate = _command(commands, "evaluate", "evaluate poses and exposures", _EVALUATE, _EVALUATE_EXAMPLES)
    _add_recording_and_out(evaluate, "recording folder")
    _add_settings(evaluate)
    evaluate.add_argument("--lidar-poses", type=Path, metavar="FILE", help="TUM, world from scan")
    evaluate.add_argument("--image-poses", type=Path, metavar="FILE", help="TUM, world from camera or body")
    evaluate.add_argument("--exposures", type=Path, metavar="FILE", help="CSV: timestamp,relative_exposure")
    evaluate.add_argument(
        "--calibration", type=Path, metavar="FILE",
        help="camera that the poses were found with: calibration.yaml of a result, or a file that `lvba import "
        "--calibration` reads (default: the recording's)",
    )  # fmt: skip
    evaluate.add_argument(
        "--reference", type=Path, metavar="DIR", help="folder of true poses to compare with"
    )


def _add_simulate(commands: "argparse._SubParsersAction[Parser]") -> None:
    simulate = _command(
        commands, "simulate", "simulate a recording with known truth", _SIMULATE, _SIMULATE_EXAMPLES
    )
    simulate.add_argument(
        "scene",
        metavar="SCENE",
        help="courtyard, rooms, corridor, street, plane, block, terrace, cabinet, site, staircase",
    )
    simulate.add_argument("--out", type=Path, required=True, metavar="RECORDING", help="folder or bag")
    simulate.add_argument("--frames", type=int, metavar="N", help="images (default: the scene's)")
    simulate.add_argument("--seed", type=int, default=0, metavar="S", help="of all randomness (default: 0)")
    levels = ["easy", "medium", "hard"]
    simulate.add_argument("--difficulty", choices=levels, default="medium", help="of the drift")
    patterns = ["spinning", "non_repetitive", "depth_camera"]
    pattern = "its scan pattern (default: spinning; depth_camera where --disturb has its errors)"
    simulate.add_argument("--lidar", choices=patterns, help=pattern)
    simulate.add_argument("--scans", type=int, metavar="N", help="scans (default: as many as images)")
    simulate.add_argument(
        "--points", type=int, default=30_000, metavar="N", help="beams of a scan (default: 30000)"
    )
    simulate.add_argument("--width", type=int, default=640, metavar="PX", help="of the images (default: 640)")
    simulate.add_argument(
        "--height", type=int, default=480, metavar="PX", help="of the images (default: 480)"
    )
    simulate.add_argument(
        "--length",
        type=float,
        metavar="M",
        help="length of the path, m (street, corridor, plane, block, terrace, site)",
    )
    simulate.add_argument(
        "--closing",
        type=float,
        nargs=2,
        metavar=("M", "DEG"),
        help="offset between the rough ends of a loop, in addition to the drift",
    )
    simulate.add_argument(
        "--image-poses",
        choices=["camera", "body"],
        default="camera",
        help="poses in image_poses.txt: camera to world, or body to world as FAST-LIVO2 writes (default: camera)",
    )
    simulate.add_argument(
        "--lens",
        choices=["pinhole", "fisheye"],
        default="pinhole",
        help="of about 65 or 160 degrees (default: pinhole)",
    )
    simulate.add_argument(
        "--disturb",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="what real sensors do, see docs/simulation.md: a number, typical or severe; as rolling_shutter=0.015",
    )
    _add_effects(simulate)
    _add_bag(simulate)


def _add_effects(simulate: Parser) -> None:
    simulate.add_argument("--vignetting", action="store_true", help="images darker towards their corners")
    simulate.add_argument(
        "--motion-blur", action="store_true", help="images blurred by motion during the exposure"
    )
    simulate.add_argument("--imu", action="store_true", help="write imu.csv too (bags have an IMU anyway)")
    simulate.add_argument("--shot-noise", action="store_true", help="image noise grows with brightness")


def _add_bag(simulate: Parser) -> None:
    simulate.add_argument(
        "--bag", choices=BAG_FORMS, help="write a bag with raw sweeps, images, IMU and odometry"
    )
    simulate.add_argument(
        "--bag-points",
        choices=BAG_LAYOUTS,
        default="livox-custom-2",
        help="the driver whose layout sweeps have (default: livox-custom-2)",
    )


def _add_inspect(commands: "argparse._SubParsersAction[Parser]") -> None:
    inspect = _command(commands, "inspect", "tell what is in a bag or folder", _INSPECT, _INSPECT_EXAMPLES)
    inspect.add_argument("source", type=Path, metavar="SOURCE", help="bag, folder of bags, or folder")
    inspect.add_argument("--json", action="store_true", help="the same for programs")


def _add_view(commands: "argparse._SubParsersAction[Parser]") -> None:
    view = _command(commands, "view", "show a result in the browser", _VIEW, _VIEW_EXAMPLES)
    view.add_argument("result", type=Path, metavar="RESULT", help="the OUT folder of a run")
    view.add_argument("--port", type=int, default=0, metavar="PORT", help="to listen on (default: any)")
    view.add_argument("--no-browser", action="store_true", help="print the address only")


def _add_export(commands: "argparse._SubParsersAction[Parser]") -> None:
    export = _command(commands, "export", "write a result in another format", _EXPORT, _EXPORT_EXAMPLES)
    export.add_argument("result", type=Path, metavar="RESULT", help="the OUT folder of a run")
    export.add_argument("format", metavar="FORMAT", help="ply, las, laz, colmap, nerfstudio, lod")
    export.add_argument(
        "--out", type=Path, metavar="PATH", help="file or folder to write (default: in RESULT)"
    )
    export.add_argument(
        "--crs",
        default="",
        metavar="CRS",
        help="las, laz: coordinate reference system, a WKT file (.prj) or EPSG:CODE; coordinates are not converted",
    )


def _command(
    commands: "argparse._SubParsersAction[Parser]", name: str, summary: str, description: str, examples: str
) -> Parser:
    command = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("--threads", type=_count, metavar="N", help="threads to use (default: all cores)")
    talk = command.add_mutually_exclusive_group()
    talk.add_argument("--quiet", action="store_true", help="no progress on stderr")
    talk.add_argument("--verbose", action="store_true", help="print details on stderr")
    return command


def _add_recording_and_out(command: Parser, recording: str) -> None:
    command.add_argument("dataset", type=Path, metavar="RECORDING", help=recording)
    command.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the result")


def _add_settings(command: Parser) -> None:
    command.add_argument("--config", type=Path, metavar="FILE", help="settings, YAML")
    command.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="one setting; may be repeated"
    )


def _add_cluster(command: Parser) -> None:
    cluster = command.add_mutually_exclusive_group()
    cluster.add_argument("--workers", type=_count, metavar="N", help="run in N worker processes")
    cluster.add_argument(
        "--scheduler", metavar="ADDRESS", help="run on a Dask cluster: tcp://HOST:PORT or tls://HOST:PORT"
    )
    command.add_argument(
        "--memory-limit", metavar="GB", help="of each of the --workers (default: an equal part)"
    )
    _add_tls(command)


def _add_tls(command: Parser) -> None:
    command.add_argument("--tls-ca", type=Path, metavar="FILE", help="PEM: authority of the cluster")
    command.add_argument("--tls-cert", type=Path, metavar="FILE", help="PEM: own certificate")
    command.add_argument("--tls-key", type=Path, metavar="FILE", help="PEM: its key")


def _count(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text} is no whole number") from None
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is not 1 or more")
    return number

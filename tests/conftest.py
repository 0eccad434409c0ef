"""What several packages' tests share: a small recording with known truth, and a guard against silent skips."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import hypothesis
import pytest
import threadpoolctl
from forked import run_forked
from made_once import made_once

from service.system.threads import limit_threads

# as every `lvba` process has it, also those of xdist: threads that spin while they wait take the processor from the tests
# that run beside. Plugins of pytest may have loaded numpy before
limit_threads(None)
threadpoolctl.threadpool_limits(1, "blas")
# the processes that tests start need not compile the sources again, whatever the machine prefers
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# nothing in the tests is timed: a busy machine must not fail them
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

ROOT = Path(__file__).resolve().parent.parent
PAGE = "tests/service/page/"
FEW_KERNELS = ("tests", "io", "foundation", "fuzz", "sources", "steps", "plan")
"""Folders of tests that need few kernels, ..."""
MANY_KERNELS = (
    "test_blank_images.py",
    "test_camera_outliers.py",
    "test_confirmed_cameras_run.py",
    "test_evaluation.py",
    "test_importing.py",
    "test_judging_size_run.py",
    "test_odometry.py",
    "test_settings_have_effects.py",
    "test_turning.py",
)
"""... and files in them that need many."""


def pytest_addoption(parser):
    parser.addoption(
        "--odd-cameras",
        type=int,
        default=6,
        metavar="N",
        help="odd calibrations run through the whole chain, 1 to 300",
    )
    parser.addoption("--no-skips", action="store_true", help="fail when a test not marked `data` is skipped")


def pytest_collection_modifyitems(items):
    """The longest files first, so that none of them is left for one of several processes at the end.

    Before them those that need few kernels, which may be compiled meanwhile: what two processes need at once, both
    compile. Deployments late: what they run is compiled by then, for which a slow machine takes minutes. After them many
    files of some seconds each.
    """
    order = {"page": -2, "workers": -1, "service": 0, "server": 0, "packages": 0, "deploy": 1}
    order |= dict.fromkeys(FEW_KERNELS, -3)
    items.sort(key=lambda item: 1 if item.path.name in MANY_KERNELS else order.get(item.path.parent.name, 2))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile`, one process has all files of the page: they share a service, a job and a browser."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            file = super()._split_scope(nodeid)
            return PAGE if file.startswith(PAGE) else file

    return Scheduling(config, log)


def pytest_sessionfinish(session, exitstatus):
    """With --no-skips, a skipped test fails the run unless it is marked `data`."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if not session.config.getoption("--no-skips") or reporter is None:
        return
    skipped = [r for r in reporter.stats.get("skipped", []) if "data" not in getattr(r, "keywords", {})]
    if skipped and session.exitstatus == pytest.ExitCode.OK:
        reporter.write_line(f"skipped without being marked data: {[r.nodeid for r in skipped]}", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A short street with 16 images of 320 x 240 and as many scans, truth in reference/."""
    from lvba import simulate

    def make(folder):
        sizes = {"width": 320, "height": 240, "points_per_scan": 6000}
        simulate.simulate("street", folder, frames=16, scans=16, length=12.0, seed=5, **sizes)

    return made_once(tmp_path_factory, "street", make)[0]


@pytest.fixture(scope="session")
def lvba():
    """Runs the command line in a process of its own."""
    return run_lvba


@pytest.fixture(scope="session")
def undisturbed(recording, lvba, tmp_path_factory):
    """The result folder of a run that nothing disturbed, and its finished process."""

    def make(folder):
        return lvba("run", recording, "--out", folder, "--reference", recording / "reference", "--threads", 2)

    out, done = made_once(tmp_path_factory, "undisturbed", make)
    # some run the same command into it again
    return shutil.copytree(out, tmp_path_factory.mktemp("run") / "out"), done


@pytest.fixture(scope="session")
def tiny_recording(tmp_path_factory):
    """A recording whose run takes seconds."""
    from real_server import make_recording

    return made_once(tmp_path_factory, "tiny", make_recording)[0]


@pytest.fixture(scope="session")
def bags(tmp_path_factory):
    """Folder of small bags of one walk (`small_bags`)."""
    from small_bags import make_bags

    return made_once(tmp_path_factory, "bags", make_bags)[0]


@pytest.fixture(scope="session")
def tiny_result(tiny_recording, lvba, tmp_path_factory):
    """The result folder of `lvba run` on the tiny recording."""

    def make(folder):
        lvba("run", tiny_recording, "--out", folder, "--threads", 2)

    return made_once(tmp_path_factory, "tiny-result", make)[0]


@pytest.fixture(scope="session")
def street_in_two(tmp_path_factory):
    """A short street that can be cut into two parts."""
    from two_parts import make_street

    return made_once(tmp_path_factory, "street-in-two", make_street)[0]


@pytest.fixture(scope="session")
def result_in_two(street_in_two, lvba, tmp_path_factory):
    """The result folder of a run of that street in two parts that nothing disturbed, and its finished process."""
    from two_parts import PARTS

    def make(folder):
        return lvba("run", street_in_two, "--out", folder, *PARTS, "--threads", 1)

    return made_once(tmp_path_factory, "result-in-two", make)


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    """A job service that several tests ask, each for things of its own."""
    from real_server import Service

    running = Service(tmp_path_factory.mktemp("service") / "data")
    yield running
    running.stop()


@pytest.fixture(scope="session")
def ready_dataset(service, tiny_recording):
    """Id of the tiny recording on the shared service."""
    from real_server import upload

    return upload(service.http, tiny_recording)


@pytest.fixture(scope="session")
def done_job(service, ready_dataset):
    """A job on the shared service that has ended well."""
    from real_server import ended, submit

    return ended(service.http, submit(service.http, ready_dataset, name="first")["id"])


@pytest.fixture(scope="module")
def bucket():
    """An S3 server on this machine, with an empty bucket."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "any",
        "AWS_SECRET_ACCESS_KEY": "any",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        client = boto3.client("s3")
        client.create_bucket(Bucket="maps")
        yield client
    server.stop()


@pytest.fixture(scope="module")
def postgres():
    """A PostgreSQL of its own; skips where it is not installed."""
    from real_server import postgres_or_skip

    server = postgres_or_skip()
    yield server
    server.stop()


@pytest.fixture(params=["sqlite", "postgres"])
def on_database(request):
    """Options of a service: none, for an SQLite of its own, or an empty database on PostgreSQL."""
    if request.param == "sqlite":
        return ()
    return ("--database", request.getfixturevalue("postgres").new_database())


def run_lvba(*arguments, code=0, program=("-m", "service.cli"), env=os.environ, **options):
    """The finished process of `lvba ARGUMENTS`, after checking its exit code.

    Forked, unless anything is said of its start: program, environment, threads.
    """
    if (
        program == ("-m", "service.cli")
        and env is os.environ
        and not options
        and "--threads" not in arguments
    ):
        return run_forked(*arguments, code=code, cwd=os.getcwd(), environment=dict(env))
    environment = {**env, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, **options)
    assert done.returncode == code, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done

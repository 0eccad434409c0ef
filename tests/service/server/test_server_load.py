"""Many clients, listeners and uploads at once: nothing is lost. How fast that goes is for the benchmark of this name."""

import os
import sys
from pathlib import Path

from real_server import Service, ended, submit, until, upload
from test_server_faults import job_processes, runs

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "benchmarks"))

import bench_load  # noqa: E402 - no package


def test_nothing_is_lost_under_a_small_load():
    load = bench_load.Load(jobs=3, clients=6, listeners=30, uploads=6, upload_bytes=1 << 20, refine=False)
    found = bench_load.run(load, seconds=1.0, first=False)
    assert {name: found[name] for name in found if name.startswith("lost")} == {
        "lost_jobs": 0,
        "lost_uploads": 0,
        "lost_events": 0,
    }
    assert all(row["calls"] for row in found["rows"])


def test_jobs_let_their_service_go_first(tiny_recording, tmp_path):
    service = Service(tmp_path / "data")
    with service.held("lidar"):
        job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
        until(service.http, f"/v1/jobs/{job_id}", runs("lidar"))
        [child] = job_processes(service.data)
        mine, own = (os.getpriority(os.PRIO_PROCESS, pid) for pid in (service.process.pid, child))
        assert own == min(mine + 5, 19)
    assert ended(service.http, job_id)["state"] == "done"
    assert service.stop() == 0

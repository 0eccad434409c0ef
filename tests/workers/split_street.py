"""A short street in two parts: what runs of it made, and runs that something happens to."""

import json
import os
import re
import subprocess
import sys
import threading
from pathlib import PurePosixPath

from real_cluster import ROOT
from toy_steps import wait_for
from two_parts import PARTS

PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply", "config.yaml"]
SENT = ("plan", "input", "recording")
"""What a driver puts into a store beside the artifacts of steps."""


def products(out):
    return {name: (out / name).read_bytes() for name in PRODUCTS}


def artifacts(folder):
    """Every file of the steps' artifacts but the manifests, which hold times."""
    paths = [p.relative_to(folder) for p in folder.glob("[!.]*/**/*") if p.is_file()]
    return {p.as_posix(): (folder / p).read_bytes() for p in paths if of_step(p)}


def artifacts_in_bucket(bucket, prefix):
    """The same of a store in the bucket `maps`."""
    pages = bucket.get_paginator("list_objects_v2").paginate(Bucket="maps", Prefix=f"{prefix}/")
    paths = [PurePosixPath(item["Key"]).relative_to(prefix) for page in pages for item in page["Contents"]]
    return {
        p.as_posix(): bucket.get_object(Bucket="maps", Key=f"{prefix}/{p}")["Body"].read()
        for p in paths
        if p.parts[0][0] != "." and of_step(p)
    }


def of_step(path):
    """Whether a file of a store belongs to the artifact of a step."""
    return path.parts[0].split("-")[0] not in SENT and path.name != "manifest.json"


def manifests(folder):
    """Of every finished step, by key: they hold times, and are new where a step was done again."""
    paths = [p for p in folder.glob("[!.]*/manifest.json") if p.parent.name.split("-")[0] not in SENT]
    return {p.parent.name: p.read_bytes() for p in paths}


def name_of(key):
    return key.rsplit("-", 1)[0]


def kind(name):
    """The stage without the numbers of part and round."""
    return re.sub(r"(-\d+)+$", "", name)


def reused(out):
    """Whether each step of the run was there already."""
    stages = json.loads((out / "report.json").read_text())["stages"][1:]
    return {stage["name"]: stage["reused"] for stage in stages}


class Driver:
    """`lvba run` of a street in a process of its own."""

    def __init__(self, street, out, *options):
        words = ["run", street, "--out", out, *PARTS, "--verbose", "--threads", 2, *options]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "service.cli", *map(str, words)],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        self.lines = []
        self._on_begin = lambda name, process: None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stderr:
            self.lines.append(line.rstrip("\n"))
            begins = re.match(r"(\S+) begins in process (\d+)", line)
            if begins:
                self._on_begin(begins[1], int(begins[2]))

    def at_every_beginning(self, do):
        """From now on call do(name of the step, process that makes it)."""
        self._on_begin = do

    def kill(self):
        self.process.kill()
        self.process.wait()

    def begun(self):
        """Names of the steps in the order in which they began, those that began again too."""
        return [line.split()[0] for line in list(self.lines) if " begins in process " in line]

    def until(self, stage):
        """Until a step of this kind begins; its name."""
        return wait_for(lambda: next((name for name in self.begun() if kind(name) == stage), None), 500)

    def ended(self, code):
        """All it said, after checking its exit code."""
        found = self.process.wait(500)
        self._reader.join()
        said = "\n".join(self.lines)
        assert found == code, f"exit code {found}\n{said}"
        return said

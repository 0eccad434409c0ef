"""The process that looks into a dataset: unpacks, opens, counts. What strangers sent is decoded here, under limits, and
not in the service.

    python -m service.server.check_process TASK.json
"""

import errno
import json
import os
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from service.cli import limit_threads
from service.server import archives, lifeline, names, object_store, store_urls
from service.server.places import size_of
from service.server.settings import Limits

_LAYOUT = ("all_pcd_body", "all_image", "pcd", "image", "Log")


def main(task_file: str) -> int:
    """0: the answer is in the file that the task names."""
    lifeline.hold()
    task = json.loads(Path(task_file).read_text())
    limits = Limits(**task["limits"])
    _limit(limits)
    limit_threads(2)
    try:
        with lifeline.alone(Path(task["lock"])):
            answer = _answer(task, limits)
    except BlockingIOError:
        return lifeline.BUSY
    partial = Path(task["answer"] + ".partial")
    partial.write_text(json.dumps(answer))
    partial.rename(task["answer"])
    return 0


def _limit(limits: Limits) -> None:
    memory, seconds = limits.validation_memory_bytes, int(limits.validation_s) + 1
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _answer(task: dict[str, Any], limits: Limits) -> dict[str, Any]:
    try:
        root = _recording(task, limits)
        return _facts(root, own=root == Path(task["files"]))
    except InputError as error:
        cause, mend = (_hidden(text, task) for text in (f"{error.where}: {error.problem}", error.mend))
        return _refused("input", cause, mend)
    except object_store.TooLargeError:
        return _refused("quota", "your datasets and results would be too large", "remove some")
    except MemoryError:
        return _refused(
            "too-much", "the check ran out of memory", "the files may be damaged: look at the largest"
        )
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        return _refused(
            "disk-full", "the disk is full", "try again when there is room, or ask who runs the server"
        )


def _hidden(text: str, task: dict[str, Any]) -> str:
    for folder in (task["files"] + ".partial", task["files"], task["folder"]):
        text = text.replace(folder, "DATASET") if folder else text
    return text


def _refused(code: str, cause: str, hint: str) -> dict[str, Any]:
    return {"error": {"code": code, "cause": cause, "hint": hint}}


def _recording(task: dict[str, Any], limits: Limits) -> Path:
    if not task["folder"]:
        return _assemble(task, limits)
    if not store_urls.is_url(task["folder"]):
        return Path(task["folder"])
    partial, files = Path(task["files"] + ".partial"), Path(task["files"])
    object_store.fetch(task["folder"], partial, limits, task["room"])
    shutil.rmtree(files, ignore_errors=True)
    partial.rename(files)
    return files


def _assemble(task: dict[str, Any], limits: Limits) -> Path:
    """The folder of the recording, made of what was uploaded; an earlier one is replaced."""
    partial, files = Path(task["files"] + ".partial"), Path(task["files"])
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    places: set[str] = set()
    for upload in task["uploads"]:
        if upload["path"]:
            _link(Path(upload["file"]), partial, upload["path"], places)
    for upload in task["uploads"]:
        if not upload["path"]:
            archives.unpack(Path(upload["file"]), partial, limits)
    root = _without_wrapping(partial)
    shutil.rmtree(files, ignore_errors=True)
    root.rename(files)
    shutil.rmtree(partial, ignore_errors=True)
    return files


def _link(file: Path, folder: Path, path: str, places: set[str]) -> None:
    target = folder / names.take(path, places)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(file, target)
    except (FileExistsError, NotADirectoryError):
        raise InputError(repr(path), "is there as a file and as a folder", "give one another name") from None


def _without_wrapping(folder: Path) -> Path:
    inside = list(folder.iterdir())
    while len(inside) == 1 and inside[0].is_dir() and inside[0].name not in _LAYOUT:
        folder, inside = inside[0], list(inside[0].iterdir())
    return folder


def _facts(root: Path, *, own: bool) -> dict[str, Any]:
    from lvba.io.dataset import open_dataset

    dataset = open_dataset(root)
    times = [*dataset.scans.times, *dataset.images.times]
    frames = [
        {"index": index, "time": float(time), "path": os.path.relpath(path, root)}
        for index, (time, path) in enumerate(zip(dataset.images.times, dataset.image_paths, strict=True))
    ]
    return {
        "frames": frames,
        "bytes": size_of(root) if own else 0,
        "files": sum(len(found) for _, _, found in os.walk(root)) if own else 0,
        "facts": {
            "scans": len(dataset.scan_paths),
            "images": len(dataset.image_paths),
            "width": dataset.camera.width if dataset.image_paths else 0,
            "height": dataset.camera.height if dataset.image_paths else 0,
            "duration_s": float(max(times) - min(times)),
            "scan_bytes": sum(os.stat(path).st_size for path in dataset.scan_paths),
            "digest": dataset.digest,
            "has_reference": (root / "reference").is_dir(),
            "warnings": [warning.replace(str(root), "DATASET") for warning in dataset.warnings],
        },
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

"""The process that looks into a dataset: unpacks, opens, counts. What strangers sent is decoded here, under limits, and
not in the service.

    python -m service.datasets.check_process TASK.json
"""

import errno
import json
import os
import re
import resource
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from lvba.errors import InputError, Lack
from lvba.io import no_links
from lvba.io.files import sync
from service.datasets import archives, check_memory, object_store, recording_names
from service.datasets.intake_budget import IntakeBudget, TooLargeError
from service.datasets.recording_names import without_wrapping
from service.settings import Limits
from service.system import deadline, durable, file_lock, process_limits, store_urls
from service.system.disk_space import LEAST_FREE, free_bytes, says_full
from service.system.paths import count_of, size_of
from service.system.threads import limit_threads


def main(task_file: str) -> int:
    """0: the answer is in the file that the task names."""
    deadline.watch()
    task = json.loads(Path(task_file).read_text())
    limits = Limits(**task["limits"])
    no_links.refuse_below(task["without_links"])
    process_limits.limit(check_memory.address_space(limits), int(limits.validation_s) + 1)
    limit_threads(2)
    try:
        with file_lock.exclusive(Path(task["lock"])):
            answer = _answer(task, limits)
            if "error" in answer:
                answer |= _clean(task)
    except BlockingIOError:
        return file_lock.EXIT_LOCKED
    partial = Path(task["answer"] + ".partial")
    partial.write_text(json.dumps(answer))
    partial.rename(task["answer"])
    return 0


def _answer(task: dict[str, Any], limits: Limits) -> dict[str, Any]:
    try:
        root = _recording(task, limits)
        return _facts(root, limits, own=root == Path(task["files"]))
    except InputError as error:
        if error.lack is Lack.MEMORY:
            return {"error": check_memory.said(limits)}
        cause, mend = (_hidden(text, task) for text in (f"{error.where}: {error.problem}", error.mend))
        return _refused("input", cause, mend, path=_inside(error.where, task))
    except TooLargeError as error:
        return _refused("quota", str(error), "remove some, or upload less")
    except MemoryError:
        return {"error": check_memory.said(limits)}
    except OSError as error:
        if error.errno == errno.ENOENT:
            cause = f"{error.filename}: has disappeared".replace(task["files"], "DATASET")
            return _refused("files", os.path.basename(cause), "upload the files again")
        if not says_full(error):
            raise
        return _refused(
            "disk-full", "the disk is full", "try again when there is room, or ask the server's administrator"
        )


def _clean(task: dict[str, Any]) -> dict[str, int]:
    """Remove what was made of a recording that is refused; what is left, on account of its owner.

    What was uploaded stays, and what was fetched from an object store: both may be gone on with.
    """
    if not task["folder"] or store_urls.is_url(task["folder"]):
        shutil.rmtree(task["files"], ignore_errors=True)
    partial = Path(task["files"] + ".partial")
    if not task["folder"]:
        shutil.rmtree(partial, ignore_errors=True)
    return {"bytes": size_of(partial), "files": count_of(partial)}


def _hidden(text: str, task: dict[str, Any]) -> str:
    for folder in (task["files"] + ".partial", task["files"], task["folder"]):
        text = text.replace(folder, "DATASET") if folder else text
    return text


def _inside(where: str, task: dict[str, Any]) -> str | None:
    """The file or folder of the recording that is meant, seen from its root; None: no one of them."""
    path = _hidden(where, task)
    if not path.startswith("DATASET/"):
        return None
    return re.sub(r"(:\d+)+$", "", path.removeprefix("DATASET/"))


def _refused(code: str, cause: str, hint: str, **more: Any) -> dict[str, Any]:
    return {"error": {"code": code, "cause": cause, "hint": hint, **more}}


def _recording(task: dict[str, Any], limits: Limits) -> Path:
    if not task["folder"]:
        return _assemble(task, limits)
    if not store_urls.is_url(task["folder"]):
        return Path(task["folder"])
    partial, files = Path(task["files"] + ".partial"), Path(task["files"])
    object_store.fetch(task["folder"], partial, limits, task["room_bytes"], task["room_files"])
    _put_in_place(partial, files)
    return files


def _assemble(task: dict[str, Any], limits: Limits) -> Path:
    """The folder of the recording, made of what was uploaded; an earlier one is replaced."""
    partial, files = Path(task["files"] + ".partial"), Path(task["files"])
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    budget = IntakeBudget(partial, limits, task["room_bytes"], task["room_files"])
    for upload in task["uploads"]:
        if upload["path"]:
            _link(Path(upload["file"]), partial, upload["path"], budget)
    for upload in task["uploads"]:
        if not upload["path"]:
            archives.unpack(Path(upload["file"]), partial, budget)
    root = without_wrapping(partial)
    _put_in_place(root, files)
    shutil.rmtree(partial, ignore_errors=True)
    return files


def _put_in_place(made: Path, files: Path) -> None:
    """Have the recording under its name, on the disk: what was uploaded goes once the dataset is ready."""
    durable.sync_all(made)
    shutil.rmtree(files, ignore_errors=True)
    made.rename(files)
    sync(files.parent)


def _link(file: Path, folder: Path, path: str, budget: IntakeBudget) -> None:
    budget.add_file(path)
    budget.add_bytes(file.stat().st_size)
    target = folder / path
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(file, target)
    except (FileExistsError, NotADirectoryError):
        raise InputError(repr(path), "is there as a file and as a folder", "give one another name") from None


def _limit_unpacked(limits: Limits) -> None:
    """A bag that is compressed as a whole is unpacked beside it, into no more than there is room for."""
    room = max(free_bytes(Path(tempfile.gettempdir())) - limits.disk_reserve_bytes, LEAST_FREE)
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (min(room, limits.archive_bytes), resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    )


def _facts(root: Path, limits: Limits, *, own: bool) -> dict[str, Any]:
    from lvba.io.dataset import open_dataset

    sizes = {"bytes": size_of(root) if own else 0, "files": count_of(root) if own else 0}
    if not recording_names.is_recording(root) and (answer := _of_source(root, limits)) is not None:
        answer["facts"]["bytes"] = sizes["bytes"]
        return {"frames": [], **sizes, **answer}
    dataset = open_dataset(root)
    times = [*dataset.scans.times, *dataset.images.times]
    frames = [
        {"index": index, "time": float(time), "path": os.path.relpath(path, root)}
        for index, (time, path) in enumerate(zip(dataset.images.times, dataset.image_paths, strict=True))
    ]
    return {
        "frames": frames,
        **sizes,
        "facts": {
            "scans": len(dataset.scan_paths),
            "images": len(dataset.image_paths),
            "width": dataset.camera.width if dataset.image_paths else 0,
            "height": dataset.camera.height if dataset.image_paths else 0,
            "duration_s": float(max(times) - min(times)),
            "scan_bytes": sum(os.stat(path).st_size for path in dataset.scan_paths),
            "digest": dataset.digest,
            "format": None,
            "has_reference": (root / "reference").is_dir(),
            "warnings": [warning.replace(str(root), "DATASET") for warning in dataset.warnings],
        },
    }


def _of_source(root: Path, limits: Limits) -> dict[str, Any] | None:
    """What is found in a bag, or a folder of another program; None: it is none."""
    # knows all that reads them, which recordings need not wait for
    from service.datasets import source_check

    _limit_unpacked(limits)
    opened = source_check.source_at(root)
    return None if opened is None else source_check.look(opened[0], root, opened[1])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

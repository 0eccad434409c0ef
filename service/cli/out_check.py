"""What the command line refuses before any work is done."""

from pathlib import Path

from lvba.errors import InputError
from lvba.io import result_folder


def check_out(out: Path, dataset: Path) -> None:
    """That OUT can hold a result without touching the recording.

    Raises InputError: it is the recording, in its frames' folders, or another recording, or holds files of somebody
        else's that would be replaced.
    """
    here, there = out.resolve(), dataset.resolve()
    frames = {there / "all_pcd_body", there / "all_image"}
    if here == there or frames & {here, *here.parents}:
        raise InputError(out, "is the recording itself", "give --out a folder of its own")
    if (out / "all_pcd_body").exists():
        raise InputError(out, "holds a recording", "give --out a folder of its own")
    result_folder.check(out)

"""What is wrong with a recording as far as its names and small texts tell: asked before gigabytes are sent.

The rules are the reader's own (`lvba.io.dataset.check_names`); nothing of scans and images is read.
"""

from pathlib import Path

_LAYOUT = ("all_pcd_body", "all_image", "pcd", "image", "Log", "velodyne")


def without_wrapping(folder: Path) -> Path:
    """The recording itself, where it lies alone in a folder, as archives often have it. Hidden files do not count."""
    inside = _seen(folder)
    while len(inside) == 1 and inside[0].is_dir() and inside[0].name not in _LAYOUT:
        folder, inside = inside[0], _seen(inside[0])
    return folder


def _seen(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if not path.name.startswith(".")]


def check(folder: Path) -> None:
    """Raises InputError: `lvba run` would refuse it, whatever scans and images hold."""
    # needs the readers of the method, which asking a server need not wait for otherwise
    from lvba.io.dataset import check_names

    root = without_wrapping(folder)
    if is_recording(root) or not _is_source(root):
        check_names(root)


def is_recording(root: Path) -> bool:
    """Whether a folder looks like a recording, which is run as it is."""
    from lvba.io import kitti
    from lvba.io.dataset import SCAN_FOLDERS

    return root.is_dir() and (kitti.is_kitti(root) or any((root / name).is_dir() for name in SCAN_FOLDERS))


def _is_source(root: Path) -> bool:
    """Whether a folder is a bag, or one of another program, by its names.

    Raises InputError: it is a bag of which a file is missing.
    """
    from lvba.sources import folders
    from lvba.sources.bags.bag_files import container_at

    return container_at(root) is not None or folders.is_known(root)

"""Folders that others than the server write into: what must not lie there, and where no link is followed."""

from pathlib import Path

from sqlalchemy.engine import make_url

from lvba.errors import InputError
from service.settings import Settings
from service.system import store_urls


def roots(settings: Settings) -> list[Path]:
    """Folders below which recordings may be registered, without links."""
    return [Path(root).resolve() for root in settings.roots if not store_urls.is_url(root)]


def folders(recording: Path, settings: Settings) -> list[str]:
    """Where whoever reads a recording must not follow links: in itself, and in the roots, where a sequence of KITTI
    has its poses beside it."""
    return [str(folder) for folder in (recording, *roots(settings))]


def check(settings: Settings) -> None:
    """That nobody can register what the server keeps to itself.

    Raises InputError: the data folder, the database or a key is below a root, or a root in the data folder.
    """
    own = {
        "the data folder": settings.data,
        "the database": _sqlite_file(settings),
        "the TLS key": settings.tls_key,
    }
    for root in roots(settings):
        for name, place in own.items():
            if place is not None and place.resolve().is_relative_to(root):
                mend = "put it elsewhere, or name the folders of the recordings as roots"
                raise InputError(place, f"{name} lies below the root {root}: it could be registered", mend)
        if root.is_relative_to(settings.data.resolve()):
            raise InputError(root, "a root lies in the data folder", "put the recordings elsewhere")


def _sqlite_file(settings: Settings) -> Path | None:
    url = make_url(settings.database_url)
    return Path(url.database) if url.get_backend_name() == "sqlite" and url.database else None

"""URLs of recordings in object stores: which may be registered."""

import re

from lvba.errors import InputError

SCHEMES = ("s3", "gs", "gcs", "az", "abfs")
"""Those of stores that ask for nothing but a name: no files of this machine, no addresses of other hosts, no chains."""
_PART = r"[A-Za-z0-9_][A-Za-z0-9._=+,@ -]*"
_URL = re.compile(rf"({'|'.join(SCHEMES)})://({_PART}(?:/{_PART})*)/?")


def is_url(place: str) -> bool:
    """Whether a place that is to be registered is a URL and not a folder."""
    return "://" in place


def checked_root(url: str) -> str:
    """A root as the settings give it, without a slash at its end.

    Raises InputError: no URL of an object store.
    """
    plain = _plain(url)
    if plain is None:
        known = ", ".join(f"{scheme}://" for scheme in SCHEMES)
        raise InputError(
            "roots", f"{url!r} is no bucket or folder in one", f"write a folder, or {known}BUCKET/PATH"
        )
    return plain


def below_roots(url: str, roots: tuple[str, ...]) -> str | None:
    """The URL without a slash at its end, where it is one of the roots or below one; else None."""
    plain = _plain(url)
    below = plain is not None and any(plain == root or plain.startswith(root + "/") for root in roots)
    return plain if below else None


def _plain(url: str) -> str | None:
    match = _URL.fullmatch(url)
    return f"{match[1]}://{match[2]}" if match else None

"""Coordinate reference systems as users name them: a file or text of WKT, or EPSG codes."""

import os
import re
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files

_WKT = re.compile(r"\s*(COMPD_CS|PROJCS|GEOCCS|GEOGCS|LOCAL_CS|VERT_CS)\s*\[", re.IGNORECASE)
_CODE = re.compile(r"EPSG:[0-9]{4,6}(\+[0-9]{4,6})?", re.IGNORECASE)
_MEND = "give a file of OGC WKT 1 (.prj, .wkt), or EPSG:25833, or EPSG:25833+7837 with heights"
_LONGEST = 64 * 1024


def wkt(given: str) -> str:
    """The OGC WKT 1 of a coordinate reference system, as LAS 1.4 wants it.

    given: the path of a file of WKT 1, such text itself, or EPSG:CODE, or EPSG:CODE+CODE with a vertical one
    Raises: InputError if it is none of these, or a code is given and the package pyproj is missing.
    """
    if _WKT.match(given):
        return given.strip()
    if _CODE.fullmatch(given):
        return _of_code(given)
    if not os.path.exists(given):
        raise InputError(given, "is no coordinate reference system, and no file", _MEND)
    text = files.read_text(Path(given), _LONGEST).strip()
    if not _WKT.match(text):
        raise InputError(given, "holds no OGC WKT 1", _MEND)
    return text


def _of_code(code: str) -> str:
    try:
        import pyproj  # only who names codes needs it
        from pyproj.exceptions import CRSError
    except ImportError as error:
        mend = "pip install pyproj, or give a file of OGC WKT 1 (.prj, from epsg.io)"
        raise InputError(f"--crs {code}", "codes need the package pyproj", mend) from error
    try:
        return str(pyproj.CRS.from_user_input(code.upper()).to_wkt("WKT1_GDAL"))
    except CRSError as error:
        raise InputError(f"--crs {code}", "is not known as a coordinate reference system", _MEND) from error

"""Readings of an IMU as CSV beside a recording: what `lvba import` and `lvba simulate` write.

imu.csv: timestamp (s, on the clock of the scans), gyroscope x y z (rad/s), accelerometer x y z (m/s^2, or g as some
drivers have it), in the IMU's axes, which are those of the scans unless `body_from_imu` of config.yaml says otherwise.
"""

import io
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.inertial.readings import ImuReadings, ordered
from lvba.io import files

NAME = "imu.csv"
HEADER = "timestamp,gyroscope_x,gyroscope_y,gyroscope_z,accelerometer_x,accelerometer_y,accelerometer_z\n"
_MEND = "write lines of timestamp, three rates and three accelerations, or remove the file"


def find(root: str | Path) -> str:
    """The path of a recording's readings; empty: there are none."""
    path = Path(root) / NAME
    return str(path) if path.is_file() else ""


def read(path: str | Path) -> ImuReadings:
    """The readings of a file, in the order of their times.

    Raises InputError: a line is not seven numbers, or there is none.
    """
    text = files.read_text(path, files.MAX_BINARY_BYTES)
    body = text[text.find("\n") + 1 :] if text[:1].isalpha() else text
    if not body.strip():
        raise InputError(path, "holds no readings", _MEND)
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2, comments="#")
    except ValueError as error:
        raise InputError(path, f"a line is not seven numbers ({str(error)[:120]})", _MEND) from error
    if table.shape[1] != 7 or not len(table):
        raise InputError(path, f"{len(table)} lines of {table.shape[1]} numbers instead of seven", _MEND)
    return ordered(table[:, 0], table[:, 1:4], table[:, 4:])


def write(path: str | Path, readings: ImuReadings) -> None:
    """Writes readings. Raises InputError: the file cannot be written."""
    lines = [
        f"{time:.6f},{','.join(f'{value:.9g}' for value in values)}\n"
        for time, values in zip(
            readings.times, np.concatenate([readings.rates, readings.forces], axis=1), strict=True
        )
    ]
    files.write_text(path, HEADER + "".join(lines))

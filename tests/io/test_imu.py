"""imu.csv: what was written comes back, and damage is one clear error."""

import numpy as np
import pytest
import small_recording

from lvba.errors import InputError
from lvba.inertial.readings import ImuReadings
from lvba.io import imu
from lvba.io.dataset import open_dataset

LINE = "1630577758.005,0.1,0.2,0.3,0.0,0.0,9.81\n"


def test_readings_come_back(tmp_path):
    rng = np.random.default_rng(0)
    times = 1630577758.0 + np.arange(50) * 0.005
    written = ImuReadings(times, rng.normal(size=(50, 3)), rng.normal(size=(50, 3)))
    imu.write(tmp_path / imu.NAME, written)
    found = imu.read(imu.find(tmp_path))
    assert np.abs(found.times - times).max() < 1e-6
    assert found.rates == pytest.approx(written.rates, rel=1e-8)
    assert found.forces == pytest.approx(written.forces, rel=1e-8)


def test_order_and_what_is_not_finite(tmp_path):
    path = tmp_path / imu.NAME
    path.write_text(
        imu.HEADER + LINE.replace("005,", "015,") + LINE + LINE.replace("9.81", "nan").replace("005,", "01,")
    )
    assert np.diff(imu.read(path).times) == pytest.approx(0.01)


@pytest.mark.parametrize(
    "text",
    [
        "",
        imu.HEADER,
        imu.HEADER + "1,2,3,4,5,6\n",
        imu.HEADER + LINE + LINE[:20],
        imu.HEADER + LINE + "a,b,c,d,e,f,g\n",
        LINE + "\0\0\0",
        "timestamp",
    ],
)
def test_damage_is_an_error_that_names_the_file(tmp_path, text):
    path = tmp_path / imu.NAME
    path.write_text(text)
    with pytest.raises(InputError, match=r"imu\.csv"):
        imu.read(path)


def test_a_recording_has_it_and_its_digest_knows(tmp_path):
    small_recording.write(tmp_path)
    without = open_dataset(tmp_path)
    assert without.imu_path == ""
    (tmp_path / imu.NAME).write_text(imu.HEADER + LINE)
    first = open_dataset(tmp_path)
    (tmp_path / imu.NAME).write_text(imu.HEADER + LINE + LINE.replace("005", "015"))
    assert len({each.digest for each in (without, first, open_dataset(tmp_path))}) == 3
    (tmp_path / imu.NAME).write_text(imu.HEADER + "no numbers\n")
    with pytest.raises(InputError, match=r"imu\.csv"):
        open_dataset(tmp_path)


def test_its_extrinsic_is_in_config_yaml(tmp_path):
    small_recording.write(tmp_path)
    (tmp_path / imu.NAME).write_text(imu.HEADER + LINE)
    same = open_dataset(tmp_path)
    assert np.array_equal(same.scan_from_imu, np.eye(4))
    config = (tmp_path / "config.yaml").read_text()
    numbers = [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]
    (tmp_path / "config.yaml").write_text(f"{config}body_from_imu: {numbers}\n")
    turned = open_dataset(tmp_path)
    assert np.array_equal(turned.scan_from_imu, np.reshape(numbers, (4, 4)))
    assert turned.digest != same.digest
    for wrong in (numbers[:12], [2 * numbers[0], *numbers[1:-1], 2], [1, *numbers[1:]]):
        (tmp_path / "config.yaml").write_text(f"{config}body_from_imu: {wrong}\n")
        with pytest.raises(InputError, match=r"config\.yaml: body_from_imu"):
            open_dataset(tmp_path)

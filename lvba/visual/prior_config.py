"""How well the calibration of a camera is known beforehand."""

from dataclasses import dataclass

import numpy as np

from lvba.settings import Group, setting

FLOOR_POSITION_M, FLOOR_ROTATION_DEG = 0.001, 0.01
"""No estimate of how far cameras are off the trajectory falls below this: frames that agree better do so by chance."""


@dataclass(frozen=True)
class PriorConfig(Group):
    """How well the calibrated extrinsic of the camera and the clocks are known."""

    extrinsic_position_m: float = setting(
        0.01,
        meaning="How far the calibrated extrinsic may be off, one standard deviation.",
        unit="m",
        low=1e-4,
        high=10,
        change_when="The calibration is known to be better, or was measured by hand.",
    )
    extrinsic_rotation_deg: float = setting(
        0.3,
        meaning="How far the calibrated extrinsic may be turned, one standard deviation.",
        unit="degrees",
        low=1e-3,
        high=90,
        change_when="The calibration is known to be better, or was measured by hand.",
    )
    time_offset_s: float = setting(
        0.02,
        meaning="How far the clocks of camera and LiDAR may be apart, one standard deviation.",
        unit="s",
        low=1e-6,
        high=10,
        change_when="The sensors are triggered by hardware (smaller), or each has a clock of its own (larger).",
    )

    @property
    def sigma(self) -> dict[str, float | np.ndarray]:
        """The standard deviation of each parameter of `states.Calibration`, in the units of its steps."""
        rotation = np.radians(self.extrinsic_rotation_deg)
        return {
            "scan_from_camera": np.repeat([rotation, self.extrinsic_position_m], 3),
            "time_offset": self.time_offset_s,
            "focal": np.array(FOCAL),
            "principal_point": PRINCIPAL_POINT_PX,
            "distortion": np.array(DISTORTION),
            "readout": READOUT_S,
            "clock_rate": self.time_offset_s / CLOCKS_PART_S,
        }


FOCAL, PRINCIPAL_POINT_PX, DISTORTION, READOUT_S = (0.01, 0.001), 5.0, (0.02, 0.02, 0.002, 0.002), 0.02
"""How far a calibration may be off, one standard deviation: relative, both focal lengths and their ratio (pixels are
square); px; k1 k2 p1 p2; s. Real ones are wrong by 0.1 to 0.5 %, 1 to 4 px and .003 to .02 of k1, and consumer cameras
read out in 5 to 30 ms."""
CLOCKS_PART_S = 20.0
"""s, in which clocks part by as much as they may be apart: by default .001 of the time. Quartz parts by .0001 at most."""

"""Calibration files of other programs, each with its own direction of extrinsics, as one calibration of a rig."""

from lvba.sources.calibrations.merging import read
from lvba.sources.calibrations.rig import RigCalibration, sized

__all__ = ["RigCalibration", "read", "sized"]

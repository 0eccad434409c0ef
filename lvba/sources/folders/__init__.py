"""Folders of other programs as sources: a module for each family, recognised by its files.

The child of a pose is the frame of the scans: poses of a camera or an IMU are turned into those of the LiDAR or depth
camera by the folder's own calibration.
"""

from lvba.sources.folders.recognising import find, is_known

__all__ = ["find", "is_known"]

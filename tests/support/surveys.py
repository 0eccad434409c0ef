"""Surveys of sources of which little matters."""

import numpy as np

from lvba.sources.importing.survey import Survey


def survey(scan_stamps, image_stamps=(), **more):
    """Of scans and images with these stamps (ns, ascending), and nothing else. more: fields that have something"""
    scans, images = np.asarray(scan_stamps, np.int64), np.asarray(image_stamps, np.int64)
    nothing = {
        "zero": int(scans[0]),
        "scan_stamps": scans,
        "image_stamps": images,
        "scans_in_order": np.ones(len(scans), bool),
        "images_in_order": np.ones(len(images), bool),
        "segments": (),
        "odometry": None,
        "child": "",
        "imu": None,
        "camera": None,
        "other_cameras": (),
        "image_size": (0, 0),
        "image_bits": 16,
        "static": {},
        "repeated": {},
        "lidar_frame": "",
        "image_frame": "",
        "imu_frame": "",
    }
    return Survey(**nothing | more)

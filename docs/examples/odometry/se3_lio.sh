#!/bin/sh
# Poses by SE(3)-LIO, which couples scans and IMU tightly; for narrow LiDARs indoors. Tried with se3-lio 0.2.0, which
# is under GPL-2: lvba runs it as a program of its own.
#
#   pip install se3-lio
#   lvba import walk.bag --out recording --odometry "sh se3_lio.sh {bag} {out} config.yaml [SCANS IMU]"
#
# It reads bags of ROS 1 with PointCloud2 (Ouster, Hesai, Velodyne), and of ROS 2 with Livox. SCANS and IMU are topics.
# config.yaml has the pose of the LiDAR on the IMU, m and quaternion w x y z:
#
#   sensors: {t_exts: [0.0, 0.0, 0.1], q_exts: [1.0, 0.0, 0.0, 0.0]}
#
# The poses are of the IMU, at the end of a sweep.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
se3_lio_pipeline "$1" --config "$3" --output "$work" --no-progress \
    ${4:+--lidar-topic "$4"} ${5:+--imu-topic "$5"}
cp "$work"/*_se3lio.tum "$2"

#!/bin/sh
# Poses by SE(3)-LIO, which couples scans and IMU tightly; for narrow LiDARs indoors. Tried with se3-lio 0.2.0, which
# is under GPL-2: lvba runs it as a program of its own.
#
#   pip install se3-lio
#   lvba import walk.bag --out recording --odometry "sh se3_lio.sh {bag} {out} se3_lio.yaml [SCANS IMU]"
#
# It reads bags of ROS 1 with PointCloud2 (Ouster, Hesai, Velodyne), and of ROS 2 with Livox. SCANS and IMU are topics.
# se3_lio.yaml, beside this file, says what to write into it. The sensors must stand still for a second or two at first:
# SE(3)-LIO takes gravity from the first readings of the IMU, and its speed for zero.
# The poses are of the IMU, at the end of a sweep.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
se3_lio_pipeline "$1" --config "$3" --output "$work" --no-progress \
    ${4:+--lidar-topic "$4"} ${5:+--imu-topic "$5"}
cp "$work"/*_se3lio.tum "$2"

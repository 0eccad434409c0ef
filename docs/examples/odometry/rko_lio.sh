#!/bin/sh
# Poses by RKO-LIO, from scans and the IMU. Tried with rko_lio 0.4.0.
#
#   pip install rko_lio rosbags 'typer<0.28'
#   lvba import walk.bag --out recording --odometry "sh rko_lio.sh {bag} {out} [SCANS IMU]"
#
# SCANS and IMU: topics, where there are several. The transform from the LiDAR to the IMU comes from tf_static.
# The poses are of the LiDAR, at the end of a sweep.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
folder=$1
if [ ! -d "$folder" ]; then # it takes a folder, and reads all bags in it
    folder=$work/bag
    mkdir "$folder"
    ln -s "$(realpath "$1")" "$folder/"
fi
rko_lio "$folder" --dataloader rosbag --log_dir "$work/log" --run_name run \
    ${3:+--lidar "$3"} ${4:+--imu "$4"}
cp "$work"/log/run_0/run_0_tum.txt "$2"

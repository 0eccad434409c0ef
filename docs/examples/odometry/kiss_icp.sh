#!/bin/sh
# Poses by KISS-ICP, from scans alone. Tried with kiss-icp 1.3.0.
#
#   pip install kiss-icp rosbags
#   lvba import walk.bag --out recording --odometry "sh kiss_icp.sh {bag} {out} [TOPIC]"
#
# They are of the LiDAR, have the stamp of the scan, and hold at the end of its sweep.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
kiss_icp_out_dir="$work" kiss_icp_pipeline "$1" ${3:+--topic "$3"}
cp "$work"/latest/*_poses_tum.txt "$2"

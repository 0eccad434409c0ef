#!/bin/sh
# Poses by GenZ-ICP, from scans alone. Tried with genz-icp 0.3.2.
#
#   pip install genz-icp rosbags
#   lvba import walk.bag --out recording --odometry "sh genz_icp.sh {bag} {out} [TOPIC]"
#
# They are of the LiDAR, have the stamp of the scan, and hold in the middle of its sweep.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
genz_icp_out_dir="$work" genz_icp_pipeline "$1" ${3:+--topic "$3"}
cp "$work"/latest/*_poses_tum.txt "$2"

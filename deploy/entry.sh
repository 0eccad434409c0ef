#!/bin/sh
# First process of the container. Compiled code needs a folder that can be written, and the root of the container
# cannot be: what was compiled when the image was built is copied to where it can.
set -eu
mkdir -p "$NUMBA_CACHE_DIR"
cp -R /opt/lvba/numba/. "$NUMBA_CACHE_DIR"
exec "$@"

#!/bin/sh
# Makes .venv and installs lvba into it: deploy/setup.sh PYTHON EXTRAS
# What only the system's package manager can give (venv on Debian, libraries that Open3D links to) is installed where
# that needs no password; elsewhere the one command to run is printed.
set -eu

python=$1
extras=$2
venv=.venv
open3d_packages="libgl1 libegl1 libx11-6 libgomp1 libusb-1.0-0 libudev1"

say() { printf '%s\n' "$*" >&2; }

system_install() {
    # $1: why; the rest: packages
    why=$1
    shift
    if ! command -v apt-get >/dev/null; then
        say "$why: install the counterparts of these Debian packages, then run make again: $*"
        exit 1
    fi
    if [ "$(id -u)" = 0 ]; then
        as_root=""
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        as_root="sudo -n"
    else
        say "$why. Run this, then make again:"
        say "    sudo apt-get update && sudo apt-get install --no-install-recommends -y $*"
        exit 1
    fi
    say "$why: installing $*"
    $as_root apt-get -qq update
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq install --no-install-recommends -y "$@" >/dev/null
}

if ! command -v "$python" >/dev/null; then
    say "$python is not here: install Python 3.11 or newer, or say where it is: make PYTHON=/path/to/python3"
    exit 1
fi
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    say "$python is $("$python" --version 2>&1), too old: make PYTHON=/path/to/python3.11 or newer"
    exit 1
fi

if [ ! -x "$venv/bin/pip" ]; then
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        system_install "Python's venv module is not complete" "python$version-venv"
    fi
    "$python" -m venv --clear "$venv"
fi

say "installing lvba[$extras] into $venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".[$extras]"

if ls -d "$venv"/lib/python*/site-packages/open3d >/dev/null 2>&1 && ! "$venv/bin/python" -c 'import open3d' 2>/dev/null; then
    # shellcheck disable=SC2086
    system_install "Open3D lacks system libraries" $open3d_packages
    "$venv/bin/python" -c 'import open3d' || { say "Open3D cannot be imported: see the error above"; exit 1; }
fi

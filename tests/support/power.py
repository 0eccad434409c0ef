"""A disk whose power can be cut: a file system in a file, which then drops all that was not synced."""

import fcntl
import os
import struct
import subprocess

import pytest
from programs import program_or_skip

_SHUTDOWN = 0x8004587D
"""EXT4_IOC_SHUTDOWN."""
_AS_IS = 2
"""Not even its journal is written any more (EXT4_GOING_FLAGS_NOLOGFLUSH)."""
_NEVER = "commit=300"
"""Seconds until it writes by itself what nobody asked it to."""


class Disk:
    """A mounted ext4, kept in memory; `folder` is its root."""

    def __init__(self, place, megabytes=300):
        if os.geteuid():
            pytest.skip("only root can mount a disk")
        make = program_or_skip("mkfs.ext4", package="e2fsprogs")
        memory, self.folder = place / "memory", place / "disk"
        self._image, self._mounted = memory / "disk.img", []
        self._mount("-t", "tmpfs", "tmpfs", memory)
        with self._image.open("wb") as image:
            image.truncate(megabytes << 20)
        subprocess.run([make, "-q", "-F", self._image], check=True)
        self._mount("-o", f"loop,{_NEVER}", self._image, self.folder)

    def _mount(self, *words):
        folder = words[-1]
        folder.mkdir(exist_ok=True)
        done = subprocess.run(["mount", *words], check=False, capture_output=True, text=True)
        if done.returncode:
            self.remove()
            pytest.skip(f"no disk can be mounted here: {done.stderr}")
        self._mounted.append(folder)

    def cut_power(self):
        """From now on nothing gets to the disk, and every access fails."""
        handle = os.open(self.folder, os.O_RDONLY)
        try:
            fcntl.ioctl(handle, _SHUTDOWN, struct.pack("I", _AS_IS))
        finally:
            os.close(handle)

    def restore_power(self):
        """What is on the disk is there again. Nobody may have a file open on it."""
        subprocess.run(["umount", self._mounted.pop()], check=True)
        self._mount("-o", f"loop,{_NEVER}", self._image, self.folder)

    def remove(self):
        """Unmount it."""
        for folder in reversed(self._mounted):
            subprocess.run(["umount", "-l", folder], check=True)

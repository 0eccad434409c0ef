"""Frames of a video file, decoded one after the other."""

from pathlib import Path

import cv2
import numpy as np

from lvba.errors import InputError
from lvba.io import files


class Video:
    """A video file, opened at the first frame that is asked for; one frame is held at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture: cv2.VideoCapture | None = None
        self._next = 0

    def size(self) -> tuple[int, int]:
        """Width and height, px, as stored: no rotation by metadata.

        Raises: InputError if the file is no video.
        """
        capture = self._opened()
        return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))

    def count(self) -> int:
        """Frames, as the file says.

        Raises: InputError as `size`
        """
        return int(self._opened().get(cv2.CAP_PROP_FRAME_COUNT))

    def frame(self, index: int) -> np.ndarray:
        """A frame, (H, W, 3) uint8, RGB; fast where frames are asked for in order.

        Raises: InputError if the video ends before, or is damaged there.
        """
        if index < self._next:
            self.close()
        capture = self._opened()
        while self._next < index:
            if not capture.grab():
                raise self._ended(index)
            self._next += 1
        ok, pixels = capture.read()
        if not ok or pixels is None:
            raise self._ended(index)
        self._next += 1
        return np.ascontiguousarray(pixels[..., ::-1])

    def close(self) -> None:
        """Closes the file; it is opened again where a frame is asked for."""
        if self._capture is not None:
            self._capture.release()
        self._capture, self._next = None, 0

    def _opened(self) -> cv2.VideoCapture:
        if self._capture is None:
            files.size(self._path, 1 << 40)
            capture = cv2.VideoCapture(str(self._path))
            if not capture.isOpened():
                raise InputError(self._path, "is no video that can be decoded", "copy the file again")
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            self._capture = capture
        return self._capture

    def _ended(self, index: int) -> InputError:
        return InputError(self._path, f"ends or is damaged before frame {index}", "copy the file again")

"""Images from sensor_msgs/Image and sensor_msgs/CompressedImage."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from lvba.sources.bags.definitions import Undecodable
from lvba.sources.source import RawImage

_RGB = "use a topic of color or gray images"
_PLAIN = {
    "rgb8": (1, 3, "rgb"),
    "bgr8": (1, 3, "bgr"),
    "rgba8": (1, 4, "rgb"),
    "bgra8": (1, 4, "bgr"),
    "mono8": (1, 1, ""),
    "mono16": (2, 1, ""),
    "rgb16": (2, 3, "rgb"),
    "bgr16": (2, 3, "bgr"),
    "rgba16": (2, 4, "rgb"),
    "bgra16": (2, 4, "bgr"),
    "8uc1": (1, 1, ""),
    "8uc3": (1, 3, "bgr"),
    "8uc4": (1, 4, "bgr"),
}
"""Encoding: bytes of a number, channels, their order. Source: sensor_msgs/image_encodings; 8UC3 is OpenCV's, so BGR."""
_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}


def image(values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawImage]:
    """The image of a sensor_msgs/Image. stamp: ns

    Raises Undecodable: its encoding is none of color or gray, or its numbers contradict each other.
    """
    encoding = values["encoding"].strip().lower()
    kind, _, pattern = encoding.partition("_")
    if encoding in _PLAIN:
        size, channels, order = _PLAIN[encoding]
        pixels = _pixels(values, size, channels)
        if order:
            pixels = pixels[..., :3] if order == "rgb" else pixels[..., 2::-1]
    elif encoding in _YUV:
        if values["width"] % 2:
            raise Undecodable("a YUV 4:2:2 image of odd width")
        pixels = cv2.cvtColor(_pixels(values, 1, 2), _YUV[encoding])
    elif kind == "bayer" and pattern[:4] in _BAYER and pattern[4:] in ("8", "16"):
        mosaic = np.ascontiguousarray(_pixels(values, int(pattern[4:]) // 8, 1))
        if min(mosaic.shape) < 3:
            raise Undecodable("a Bayer image of less than 3 pixels")
        pixels = cv2.cvtColor(mosaic, _BAYER[pattern[:4]])
    elif encoding in ("16uc1", "32fc1"):
        raise Undecodable(f"a depth image ({encoding.upper()}): {_RGB}")
    else:
        raise Undecodable(f"an encoding that is not known, {encoding[:40]!r}: {_RGB}")
    yield RawImage(stamp, frame, pixels=np.ascontiguousarray(pixels))


def _pixels(values: dict[str, Any], size: int, channels: int) -> np.ndarray:
    """(H, W) or (H, W, channels) uint8 or uint16, in the byte order of the machine."""
    height, width, step, data = (values[name] for name in ("height", "width", "step", "data"))
    if not height or not width:
        raise Undecodable("it has no pixels")
    row = width * channels * size
    step = step if step >= row else row
    if (height - 1) * step + row > len(data):
        raise Undecodable("its pixels are more than its bytes")
    order = ">" if values["is_bigendian"] and size > 1 else "<"
    kind = np.dtype(f"{order}u{size}")
    strided: np.ndarray = np.ndarray((height, width, channels), kind, data, 0, (step, channels * size, size))
    pixels = strided.astype(kind.newbyteorder("="))
    return pixels[..., 0] if channels == 1 else pixels


def compressed(values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawImage]:
    """The image of a sensor_msgs/CompressedImage: the bytes of a JPEG or PNG file, as they are. stamp: ns

    Raises Undecodable: it is neither, or not an image of color or gray.
    """
    form = values["format"].strip().lower()
    if "compresseddepth" in form:
        raise Undecodable(f"a depth image (compressedDepth): {_RGB}")
    data = values["data"]
    start = bytes(data[:8])
    if form.startswith("bayer") and "bgr8" not in form and "rgb8" not in form:
        raise Undecodable("a Bayer mosaic that is compressed: use the topic of the whole images")
    if form.startswith(("16uc1", "32fc1")):
        raise Undecodable(f"a depth image ({form[:5].upper()}): {_RGB}")
    if start.startswith(b"\xff\xd8\xff"):
        suffix = ".jpg"
    elif start == b"\x89PNG\r\n\x1a\n":
        suffix = ".png"
    else:
        raise Undecodable(f"neither a JPEG nor a PNG, format {form[:40]!r}")
    yield RawImage(stamp, frame, encoded=bytes(data), suffix=suffix)

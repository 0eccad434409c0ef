"""Which camera info goes with a topic of images: by their namespaces, and by frames where these leave it open."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lvba.camera import Camera

_NAME = "camera_info"
_TRANSPORTS = ("compressed",)
"""Last parts of names that are not of the namespace: image_transport puts them below the name of the images."""


@dataclass(frozen=True)
class CameraTopic:
    """What a topic of camera infos says. frame: of its header; other, rectified: as of `CameraInfo`"""

    name: str
    frame: str
    camera: Camera
    other: Camera | None = None
    rectified: bool = False


def any_size(camera: Camera) -> bool:
    """Whether the images may be of a camera, where their size is not known: always."""
    return True


def of_images(
    topics: Sequence[CameraTopic], image: str, frame: str, fits: Callable[[Camera], bool] = any_size
) -> CameraTopic | None:
    """The topic that says the camera of the images; None: none does, or several that differ.

    A topic beside the images counts most. Then come, in this order, topics in namespaces around them that have their
    frame, the nearest first; topics elsewhere that have their frame and fit; and topics around them of another frame.

    image: topic of the images; frame: of their headers; fits: whether they may be of a camera, by their size
    """
    beside = [each for each in topics if _is_beside(each.name, image)]
    around = [each for each in topics if image.startswith(_namespace(each.name)) and each not in beside]
    same = [each for each in topics if frame and each.frame == frame]
    groups = (
        beside,
        _nearest([each for each in around if each in same]),
        [each for each in same if each not in around and fits(each.camera)],
        _nearest(around),
    )
    return next((_only(group, frame) for group in groups if group), None)


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0] + "/"


def _is_beside(info: str, image: str) -> bool:
    base, _, last = image.rpartition("/")
    base = base if last in _TRANSPORTS else image
    return _namespace(info) in (_namespace(base), f"{base}/")


def _nearest(topics: list[CameraTopic]) -> list[CameraTopic]:
    depth = max((len(_namespace(each.name)) for each in topics), default=0)
    return [each for each in topics if len(_namespace(each.name)) == depth]


def _only(topics: list[CameraTopic], frame: str) -> CameraTopic | None:
    """The one of them that has the frame, or the usual name; None: they differ, and neither tells them apart."""
    topics = [each for each in topics if each.frame == frame] or topics
    topics = [each for each in topics if each.name.endswith(f"/{_NAME}")] or topics
    return topics[0] if all(each.camera == topics[0].camera for each in topics) else None

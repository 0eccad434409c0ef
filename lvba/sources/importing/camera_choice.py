"""Whether images are raw or rectified, where a camera info says both cameras: by their name, unless they show otherwise.

kitti2bag, for one, names rectified images image_raw, and writes the K and D of the raw ones beside them.
"""

from dataclasses import replace

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.sources.importing import decision, image_readings
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.image_readings import ImagePair, ImageScorer, TimedImage
from lvba.sources.importing.rig import RigFacts

QUESTION = "images"
RAW, RECTIFIED = "raw", "rectified"
_BY = "name of the topic"
_CLEAR_GAIN = 0.1
"""Logarithm of scores by which the other camera must be better: two that hardly differ may do so for another reason."""


def choose(
    scorer: ImageScorer, rig: RigFacts, offsets: dict[str, float], said: dict[str, str], where: object
) -> tuple[ImageScorer, Camera, tuple[Decision, ...]]:
    """The camera of the images, what scores readings by it, and the decision, none where there is one camera.

    scorer: by the camera of the rig; the other arguments are as of `image_readings.find`, with `images` among the answers
    Raises InputError: data contradict what an option says, or there is no such camera.
    """
    usual, other = rig.camera, rig.other_camera
    assert usual is not None
    names = (RECTIFIED, RAW) if rig.rectified else (RAW, RECTIFIED)
    asked = said.get(QUESTION, "")
    if other is None:
        if asked and not (asked == RAW and not rig.rectified):
            problem = "is not possible here: no camera info says that camera beside the one of other images"
            raise InputError(f"--convention {QUESTION}={asked}", problem, "leave it out")
        return scorer, usual, ()
    scorers = (scorer, _by_camera(scorer, usual, other))
    if not scorer.pairs:
        index = names.index(asked) if asked else 0
        return scorers[index], (usual, other)[index], ()
    answers = [
        Answer(name, each.scores(image_readings.best(each, offsets, said)))
        for name, each in zip(names, scorers, strict=True)
    ]
    decided = decision.decide(QUESTION, answers, asked, names[0], "unlikeness", where, known_by=_BY)
    if decided.by == "data" and decided.taken != names[0]:
        decided = _overruled(decided, answers)
    index = names.index(decided.taken)
    return scorers[index], (usual, other)[index], (decided,)


def _overruled(decided: Decision, answers: list[Answer]) -> Decision:
    """The decision for the other camera, with a warning, where it is clear; else for the usual one, the first answer."""
    usual, other = answers
    if decided.margin < _CLEAR_GAIN:
        return replace(decided, taken=usual.name, by=_BY)
    words = (
        f"{QUESTION}: by their topic they are {usual.name}, but points look more alike in them by the camera of "
        f"{other.name} ones (unlikeness {other.score:.2f} against {usual.score:.2f}): that is taken"
    )
    return replace(decided, warning=words)


def _by_camera(scorer: ImageScorer, usual: Camera, other: Camera) -> ImageScorer:
    """The same pairs of images, as those of another camera."""
    images: dict[int, TimedImage] = {}

    def of_other(image: TimedImage) -> TimedImage:
        if id(image) not in images:
            images[id(image)] = replace(image, camera=other.scaled(image.camera.fx / usual.fx))
        return images[id(image)]

    pairs = [
        ImagePair(of_other(pair.one), of_other(pair.other), pair.points, pair.segment)
        for pair in scorer.pairs
    ]
    return ImageScorer(scorer.lidar, scorer.camera_from_lidar, pairs, scorer.added)

"""Never worse than the input: each stage's result is judged, and its input kept where it is no better.

LiDAR by mean map entropy, cameras and exposures by how well the map colored from other images predicts an image
(leave-one-out PSNR). Neither needs truth.
"""

from dataclasses import dataclass

import numpy as np

from lvba.products.evaluate import Scores

ROUGH, CARRIED, EXPOSED, VISUAL = "rough", "carried", "exposed", "visual"
"""States under judgement: the input; cameras carried along with the scans; those with the exposures found; and with the
camera poses found as well."""


@dataclass(frozen=True)
class GateConfig:
    """What a stage must gain to be accepted."""

    enabled: bool = True
    """False: accept every stage's result, whatever it is worth (for ablations)."""
    min_entropy_gain: float = 0.001
    """How much lower the map entropy must be, nats; 0 to 10. 0.001 is what 1 mm does to a map of 2 cm noise."""
    fusion_loss: float = 0.05
    """What part of the map entropy that refined scans gained may be given back where cameras move them; 0 to 1."""
    confidence: float = 2.0
    """Standard errors (over images) by which images must be predicted better, for cameras and exposures; 0 to 100."""
    contradiction: float = 3.0
    """Standard errors by which images must be predicted worse for a crisper map to be given up; 0 to 100."""

    def __post_init__(self) -> None:
        for name, high in (
            ("min_entropy_gain", 10.0), ("fusion_loss", 1.0), ("confidence", 100.0), ("contradiction", 100.0),
        ):  # fmt: skip
            if not 0 <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name)}, must be within 0 to {high}")


@dataclass(frozen=True)
class Verdict:
    """Whether a stage's result is used, and why, in a sentence for the report."""

    accepted: bool
    reason: str


def judge_scans(entropy_before: float, entropy_after: float, config: GateConfig) -> Verdict:
    """Whether refined scan poses make a crisper map. Entropies in nats, NaN where a map cannot be judged."""
    change = f"mean map entropy {entropy_before:.4f} -> {entropy_after:.4f}"
    if not config.enabled:
        return Verdict(True, f"accepted unjudged (gate.enabled is false): {change}")
    if not np.isfinite([entropy_before, entropy_after]).all():
        return Verdict(False, "input poses kept: the map is too thin to be judged by its entropy")
    if entropy_before - entropy_after > config.min_entropy_gain:
        return Verdict(True, f"accepted: {change}")
    return Verdict(False, f"input poses kept: the refined map is not crisper ({change})")


def judge_fusion(
    entropy_rough: float, entropy_before: float, entropy_after: float, config: GateConfig
) -> Verdict:
    """Whether scans that were moved towards the cameras still make a crisp map. Entropies in nats.

    It need not be crisper: the poses before are those at which the planes are thinnest, which are not the true ones where
    planes leave scans open. In two of five simulated rooms the map at the true poses has lost 1.3 % of what they gained.
    """
    change = f"mean map entropy {entropy_before:.4f} -> {entropy_after:.4f}"
    allowed = max(config.min_entropy_gain, config.fusion_loss * (entropy_rough - entropy_before))
    if not config.enabled:
        return Verdict(True, f"accepted unjudged (gate.enabled is false): {change}")
    if entropy_after - entropy_before <= allowed:
        return Verdict(True, f"accepted: {change}")
    return Verdict(False, f"scans stay where the LiDAR has them: the map would be less crisp ({change})")


def judge_cameras(scores: dict[str, Scores], config: GateConfig) -> tuple[Verdict, Verdict]:
    """Whether the camera poses, and whether the exposures, that the visual stage found predict the images better.

    scores: of the states CARRIED, EXPOSED and VISUAL
    """
    poses = _judge(scores[EXPOSED], scores[VISUAL], "camera poses", config)
    exposures = _judge(
        scores[CARRIED], scores[VISUAL if poses.accepted else EXPOSED], "relative exposures", config
    )
    if poses.accepted and not exposures.accepted:
        # they were judged with these exposures; without them nothing is known about them
        poses = Verdict(
            False, f"input camera poses kept, because exposures were rejected ({exposures.reason})"
        )
    return poses, exposures


def judge_all(rough: Scores, final: Scores, config: GateConfig) -> Verdict:
    """Whether the images contradict all that was accepted: they are predicted worse than from the input, beyond chance.

    Scan poses may make the map crisper and still be wrong, by sliding where planes leave it open: images see that.
    """
    gain, error = paired_gain(rough, final, "psnr_leave_one_out")
    if not config.enabled or not np.isfinite(error):
        return Verdict(True, "")
    words = f"leave-one-out PSNR {rough.psnr_leave_one_out:.3f} -> {final.psnr_leave_one_out:.3f} dB"
    if gain < -config.contradiction * error:
        return Verdict(False, f"input kept: images are predicted worse than from the input ({words})")
    return Verdict(True, "" if gain >= 0 else f"images are predicted no better, within chance ({words})")


def paired_gain(before: Scores, after: Scores, name: str) -> tuple[float, float]:
    """Mean over images of the gain in one score, and its standard error; NaN with fewer than three images."""
    gains = after.per_image[name] - before.per_image[name]
    gains = gains[np.isfinite(gains)]
    if len(gains) < 3:
        return float("nan"), float("nan")
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))


def _judge(before: Scores, after: Scores, what: str, config: GateConfig) -> Verdict:
    change = f"leave-one-out PSNR {before.psnr_leave_one_out:.3f} -> {after.psnr_leave_one_out:.3f} dB"
    if not config.enabled:
        return Verdict(True, f"accepted unjudged (gate.enabled is false): {change}")
    # over all pixels covered, as reported, and over those that both cover: a state must not win by covering less
    gains = [paired_gain(before, after, name) for name in ("psnr_leave_one_out", "psnr_common")]
    if not np.isfinite(gains).all():
        return Verdict(
            False, f"input {what} kept: hardly a pixel is seen by two images, so nothing can be judged"
        )
    if all(gain > config.confidence * error for gain, error in gains):
        return Verdict(True, f"accepted: {change}")
    common = f"{before.psnr_common:.3f} -> {after.psnr_common:.3f} dB over the pixels covered by both"
    return Verdict(
        False, f"input {what} kept: images are not predicted better, beyond chance ({change}; {common})"
    )

"""How the report writes numbers, lengths and verdicts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lvba.products import lengths, part_verdicts
from lvba.wording import joined

MISSING = "\N{EN DASH}"


@dataclass(frozen=True)
class Measure:
    """One figure of the evaluation: how it is named, written and read."""

    key: str
    name: str
    unit: str
    digits: int
    higher_is_better: bool | None


MEASURES = (
    Measure("psnr_leave_one_out", "PSNR, leave-one-out", "dB", 2, True),
    Measure("ssim_leave_one_out", "SSIM, leave-one-out", "", 3, True),
    Measure("map_entropy", "Mean map entropy", "nats", 3, False),
    Measure("psnr_common", "PSNR, leave-one-out, same pixels", "dB", 2, True),
    Measure("ssim_common", "SSIM, leave-one-out, same pixels", "", 3, True),
    Measure("psnr", "PSNR, paper protocol", "dB", 2, True),
    Measure("ssim", "SSIM, paper protocol", "", 3, True),
    Measure("psnr_held_out", "PSNR, held-out images", "dB", 2, True),
    Measure("ssim_held_out", "SSIM, held-out images", "", 3, True),
    Measure("psnr_full", "PSNR, paper protocol, holes black", "dB", 2, True),
    Measure("ssim_full", "SSIM, paper protocol, holes black", "", 3, True),
    Measure("psnr_full_leave_one_out", "PSNR, leave-one-out, holes black", "dB", 2, True),
    Measure("ssim_full_leave_one_out", "SSIM, leave-one-out, holes black", "", 3, True),
    Measure("coverage", "Coverage", "%", 1, None),
    Measure("coverage_leave_one_out", "Coverage, leave-one-out", "%", 1, None),
)


def number(value: Any, digits: int = 2, unit: str = "") -> str:
    """A number with a true minus sign and its unit; a dash where it is missing."""
    if not isinstance(value, int | float):
        return MISSING
    digits_text = f"{value:,.{digits}f}".replace("-", "\N{MINUS SIGN}").replace(",", "\N{THIN SPACE}")
    return f"{digits_text}\N{NO-BREAK SPACE}{unit}" if unit else digits_text


def measure(value: Any, kind: Measure, unit: bool = True) -> str:
    """A figure of the evaluation as its measure is written, with its unit unless that is said elsewhere."""
    if kind.unit == "%" and isinstance(value, int | float):
        value = 100 * value
    return number(value, kind.digits, kind.unit if unit else "")


def length(meters: Any) -> str:
    """A length in mm, or in m from one meter on; a dash where it is missing."""
    if not isinstance(meters, int | float):
        return MISSING
    return lengths.text(meters, "\N{NO-BREAK SPACE}").replace("-", "\N{MINUS SIGN}")


def angle(degrees: Any) -> str:
    """An angle in degrees, with more digits where it is small."""
    if not isinstance(degrees, int | float):
        return MISSING
    return number(degrees, 2 if abs(degrees) >= 1 else 3 if abs(degrees) >= 0.01 else 4) + "°"


def count(value: Any) -> str:
    """A whole number, thousands set apart."""
    return number(value, 0)


def verdict(facts: Mapping[str, Any]) -> str:
    """How the result compares with the input, in a sentence or two of HTML without user text."""
    rough, refined = (facts.get("evaluation", {}).get(name) or {} for name in ("rough", "refined"))
    sentences = []
    before, after = rough.get("psnr_leave_one_out"), refined.get("psnr_leave_one_out")
    if before is not None and after is not None:
        gain = after - before
        change = f"{number(abs(gain), 2, 'dB')} {'higher' if gain > 0 else 'lower'} than"
        if abs(gain) <= 0.005:
            change = "the same as"
        sentences.append(f"Leave-one-out PSNR is <strong>{change}</strong> before.")
    before, after = rough.get("map_entropy"), refined.get("map_entropy")
    if before is not None and after is not None and abs(after - before) > 5e-4:
        word = "sharper" if after < before else "less sharp"
        sentences.append(f"Surfaces of the map are <strong>{word}</strong>.")
    kept = [
        _KEPT[part.name]
        for part in part_verdicts.of_report(facts)
        if not part.accepted and part.name in _KEPT
    ]
    if kept:
        sentences.append(
            f"The input's <strong>{joined(kept)} were kept</strong>, for the reasons given below."
        )
    return " ".join(sentences)


_KEPT = {"scans": "scan poses", "cameras": "camera poses", "exposures": "exposures"}

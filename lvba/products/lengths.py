"""Lengths as people read them: the one rule for reports, verdicts and tables."""


def text(meters: float, space: str = " ") -> str:
    """A length in mm with about two digits, or in m from one meter on.

    meters: m; space: between number and unit
    """
    size = abs(meters)
    value, unit = (meters, "m") if size >= 1 else (1000 * meters, "mm")
    digits = 2 if abs(value) < 1 else 1 if abs(value) < 10 else 0
    return f"{value:.{digits}f}{space}{unit}"

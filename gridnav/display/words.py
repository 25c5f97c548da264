"""Numbers in words, for pages and sentences."""

from __future__ import annotations


def percent(share: float, digits: int = 1) -> str:
    """A share of 1, such as ``95.5 %``."""
    return f"{100 * share:.{digits}f} %"


def percent_interval(triple: tuple[float, float, float]) -> str:
    """A share with the ends of its interval, which is left out where it has no width."""
    value, low, high = triple
    return percent(value) + ("" if low == high else f" ({100 * low:.1f} to {percent(high)})")


def thousands(number: float) -> str:
    """A whole number with its thousands apart, by a narrow space at which no line breaks."""
    return f"{round(number):,}".replace(",", "\u202f")

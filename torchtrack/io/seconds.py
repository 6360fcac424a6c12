"""Exact conversion between decimal seconds in text files and integer microseconds.

A binary float cannot hold most decimal fractions, so ``int(float("2.097134") * 1e6)`` may be a microsecond short.
Seconds are therefore parsed as decimals and rounded to the nearest microsecond, halves up (towards later times).
"""

from decimal import ROUND_FLOOR, Context, Decimal, InvalidOperation

from torchtrack.config.events import TimeUnit

_US_PER_UNIT: dict[TimeUnit, Decimal] = {"s": Decimal(1_000_000), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}
_HALF = Decimal("0.5")
# Enough digits that nothing is rounded before the floor, for any time that fits 64 bits.
_EXACT = Context(prec=100)
_LARGEST_US = 2**63 - 1


def parse_seconds(text: str) -> int:
    """Microseconds of a decimal number of seconds, e.g. ``"2.097134001"`` -> 2097134.

    Raises:
        ValueError: if the text is no finite number, or its microseconds do not fit 64 bits.
    """
    return parse_time(text, "s")


def parse_time(text: str, unit: TimeUnit) -> int:
    """Microseconds of a decimal number of a unit, rounded to the nearest, halves up.

    Raises:
        ValueError: if the text is no finite number, or its microseconds do not fit 64 bits.
    """
    try:
        time = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text}' is not a number") from None
    if not time.is_finite() or time.adjusted() > 21:
        raise ValueError(f"'{text}' is not a time in {unit}")
    t_us = int(_EXACT.add(_EXACT.multiply(time, _US_PER_UNIT[unit]), _HALF).to_integral_value(ROUND_FLOOR))
    if abs(t_us) > _LARGEST_US:
        raise ValueError(f"'{text}' {unit} do not fit 64 bits of microseconds")
    return t_us


def format_seconds(t_us: int) -> str:
    """Seconds with six decimals, e.g. 2097134 -> ``"2.097134"``."""
    whole, fraction = divmod(abs(t_us), 1_000_000)
    return f"{'-' if t_us < 0 else ''}{whole}.{fraction:06d}"

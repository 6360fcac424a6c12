"""Whether times can be in the unit that they are taken for: one check for every reader of times whose unit the file does not say.

What is known without the unit: how many come in a unit of time (cameras give thousands to hundreds of millions of events a second),
whether they would lie beyond any clock, and that seconds of events are no whole numbers.

A unit that cannot be right is an error which names the likely one; one that is unusual, where another would be usual, is a warning.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.errors import EventDataError, TorchtrackWarning

US_PER_UNIT: dict[TimeUnit, float] = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
UNIT_NAMES: dict[TimeUnit, str] = {"s": "seconds", "ms": "milliseconds", "us": "µs", "ns": "ns"}
# Unix time in the year 2106: no clock shows more.
_LATEST_S = 2.0**32
# Of so many numbers at least a few would have decimals if they were seconds.
_FEWEST_WHOLE = 4
_GROUPS = 10
# So many of the first times are looked at: enough for a rate, and little beside the reading.
ENOUGH_TIMES = 16_000
# Of fewer steps in time, the rate is chance.
_FEWEST_STEPS = 40


@dataclass(frozen=True)
class Timed:
    """What has times: its name, how many there are in a second, and the setting that says their unit.

    Args:
        name: for messages, as in "events".
        setting: the setting, and where else the unit can be said.
        possible, usual: least and most in a second.
        fewest: of fewer the rate says nothing that would be an error; of twice as many, it may be doubted.
    """

    name: str
    setting: str
    possible: tuple[float, float]
    usual: tuple[float, float]
    fewest: int


EVENTS = Timed("events", "events.time_unit (--time-unit)", possible=(10.0, 5e9), usual=(1e3, 2e8), fewest=300)


@dataclass(frozen=True)
class TimeNumbers:
    """What is known of numbers that are times, whatever their unit.

    Args:
        shown: the first two that differ, for messages.
        distance: from zero: the median, so that a single wild time does not count.
        rate: how many there are in one of the unit; None where there are too few to say.
        count: how many numbers were looked at.
        whole: whether all are whole numbers, and differ.
    """

    shown: tuple[float, ...]
    distance: float
    rate: float | None
    count: int
    whole: bool

    @classmethod
    def from_values(cls, numbers: np.ndarray, fewest: int) -> "TimeNumbers | None":
        """Look at numbers in the order of the file; None where there are none that are finite."""
        values = numbers[np.isfinite(numbers)].astype(np.float64)
        if len(values) == 0:
            return None
        later = values[values != values[0]][:1]
        whole = len(np.unique(values[:1000])) >= _FEWEST_WHOLE and bool((values == np.floor(values)).all())
        return cls((values[0].item(), *later.tolist()), float(np.median(np.abs(values))), _rate(values, fewest), len(values), whole)


def _rate(values: np.ndarray, fewest: int) -> float | None:
    """How many there are in one of the unit: the median of groups, which a jump or a wrap of the clock leaves as it is."""
    if len(values) < fewest or np.count_nonzero(np.diff(values)) < _FEWEST_STEPS:
        return None
    size = len(values) // _GROUPS
    groups = values[: size * _GROUPS].reshape(_GROUPS, size)
    span = float(np.median(groups.max(axis=1) - groups.min(axis=1)))
    if span > 0:
        return (size - 1) / span
    span = float(values.max() - values.min())
    return (len(values) - 1) / span if span > 0 else None


def settled_unit(numbers: np.ndarray, custom: TimeUnit, stated: TimeUnit | None, source: str, timed: Timed = EVENTS) -> TimeUnit:
    """The unit of times: as told, else by the format's custom, where that is plausible.

    Args:
        numbers: the first times as they are in the file, in its order: some tens of thousands are enough.
        custom: the unit that the format has where nobody says another.
        stated: the unit that the user or the file says.
        source: name of the source, for messages.
        timed: what has these times.

    Raises:
        EventDataError: if nobody says the unit, and the custom cannot be right.
    """
    if stated is not None:
        return stated
    times = TimeNumbers.from_values(numbers[:ENOUGH_TIMES], timed.fewest)
    if times is None or (fault := _fault(times, custom, timed)) is None:
        return custom
    shown = ", ".join(f"{number:.10g}" for number in times.shown)
    likely = [unit for unit in US_PER_UNIT if unit != custom and _is_usual(times, unit, timed) and _fault(times, unit, timed) is None]
    fits = f" {' or '.join(UNIT_NAMES[unit] for unit in likely)} would fit." if likely else ""
    setting = f"Set {timed.setting} to {' or '.join(likely) if likely else 's, ms, us or ns'}"
    if fault.possible:
        # Where nothing else fits better, the custom stands.
        if likely:
            message = (
                f"{source}: times {shown}, … are read as {UNIT_NAMES[custom]}, but {fault.reason}.{fits} {setting}, or to {custom} if that is right."
            )
            warnings.warn(message, TorchtrackWarning, stacklevel=2)
        return custom
    raise EventDataError(
        f"{source}: times {shown}, … cannot be {UNIT_NAMES[custom]}: {fault.reason}.{fits} {setting}; {custom} if they are that after all."
    )


@dataclass(frozen=True)
class _Fault:
    """What speaks against a unit, and whether it may be the unit all the same."""

    reason: str
    possible: bool


def _fault(times: TimeNumbers, unit: TimeUnit, timed: Timed) -> _Fault | None:
    latest_s = times.distance * US_PER_UNIT[unit] * 1e-6
    if latest_s > _LATEST_S:
        return _Fault(f"that would be {latest_s / 31_556_952:,.0f} years", possible=False)
    if unit == "s" and times.whole:
        return _Fault("they are whole numbers", possible=False)
    if times.rate is None:
        return None
    rate = _per_second(times, unit)
    reason = f"that would be {rate:,.3g} {timed.name} a second"
    if not timed.possible[0] <= rate <= timed.possible[1]:
        return _Fault(reason, possible=False)
    return _Fault(reason, possible=True) if times.count >= 2 * timed.fewest and not _is_usual(times, unit, timed) else None


def _is_usual(times: TimeNumbers, unit: TimeUnit, timed: Timed) -> bool:
    return times.rate is None or timed.usual[0] <= _per_second(times, unit) <= timed.usual[1]


def _per_second(times: TimeNumbers, unit: TimeUnit) -> float:
    return 1e6 * (times.rate or 0.0) / US_PER_UNIT[unit]


def whole_microseconds(numbers: np.ndarray, unit: TimeUnit, source: str) -> np.ndarray:
    """Numbers of a unit as whole µs, int64, rounded to the nearest, halves up.

    Raises:
        EventDataError: if one is not finite, or does not fit 64 bits.
    """
    if numbers.dtype.kind in "iu":
        if unit == "us" and numbers.dtype.str[1:] != "u8":
            return numbers.astype(np.int64, copy=False)
        if unit == "ns":
            # Divided before anything is added: the largest numbers have no room.
            return (numbers // 1000 + (numbers % 1000 >= 500)).astype(np.int64)
        _check_range(numbers, unit, source)
        return numbers.astype(np.int64) * np.int64(US_PER_UNIT[unit])
    _check_range(numbers, unit, source)
    return np.floor(numbers.astype(np.float64) * US_PER_UNIT[unit] + 0.5).astype(np.int64)


def _check_range(numbers: np.ndarray, unit: TimeUnit, source: str) -> None:
    """Raise unless all are finite and their µs fit 64 bits."""
    if not len(numbers):
        return
    if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
        raise EventDataError(f"{source}: {int((~np.isfinite(numbers)).sum())} times are not finite numbers. Leave these events out.")
    furthest = max(abs(float(numbers.min())), abs(float(numbers.max())))
    if furthest * US_PER_UNIT[unit] >= 2.0**63:
        raise EventDataError(f"{source}: a time of {furthest:.10g} {UNIT_NAMES[unit]} does not fit 64 bits of µs. Check {EVENTS.setting}.")

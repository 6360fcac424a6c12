import warnings

import numpy as np
import pytest

from torchtrack.errors import EventDataError, TorchtrackWarning
from torchtrack.io.plausibility import EVENTS, US_PER_UNIT, TimeNumbers, settled_unit, whole_microseconds

# 3,000 events in 10 ms, in µs.
TIMES_US = np.sort(np.random.default_rng(0).integers(0, 10_000, 3000))
UNIX_US = 1_700_000_000_000_000


def silent(numbers, custom, stated=None):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return settled_unit(np.asarray(numbers), custom, stated, "file")


@pytest.mark.parametrize("start_us", [0, UNIX_US, 40 * 86_400_000_000])
def test_the_custom_of_a_format_stands_where_it_is_plausible(start_us):
    assert silent(TIMES_US + start_us, "us") == "us"
    assert silent((TIMES_US + start_us) / 1e6, "s") == "s"


def test_floats_of_microseconds_are_no_seconds():
    for numbers in (TIMES_US.astype(float), TIMES_US.astype(np.float32), TIMES_US[::600].astype(float)):
        with pytest.raises(EventDataError, match=r"file: times .* cannot be seconds: they are whole numbers.* µs.* events.time_unit"):
            settled_unit(numbers, "s", None, "file")


def test_a_rate_that_no_camera_has_is_refused_with_the_unit_that_fits():
    slow = np.arange(3000) * 3.3
    with pytest.raises(EventDataError, match=r"cannot be seconds: that would be 0.303 events a second.*µs would fit.*to us"):
        settled_unit(slow, "s", None, "file")


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "ns"), (1e-3, "ms"), (1e-6, "s")])
def test_absolute_times_of_another_unit_are_refused(scale, unit):
    custom = "us" if scale > 1 else "s"
    numbers = (TIMES_US + UNIX_US) * (1000 if unit == "ns" else scale)
    if unit == "s":
        assert silent(numbers, custom) == "s"
        return
    with pytest.raises(EventDataError, match=rf"would be 5\d,\d+ years.* to .*{unit}"):
        settled_unit(numbers, custom, None, "file")


def test_a_rate_that_is_unusual_is_told():
    with pytest.warns(
        TorchtrackWarning, match=r"read as µs, but that would be \d\d\d events a second. ns would fit. Set .* to ns, or to us if that is right"
    ):
        assert settled_unit(TIMES_US * 1000, "us", None, "file") == "us"
    with pytest.warns(TorchtrackWarning, match="read as µs.* milliseconds would fit"):
        assert settled_unit(np.arange(60_000) // 300, "us", None, "file") == "us"


def test_what_was_told_is_not_questioned():
    assert silent(TIMES_US.astype(float), "s", stated="s") == "s"
    assert silent(TIMES_US * 1000, "us", stated="ns") == "ns"


def test_few_events_and_equal_times_say_nothing():
    assert silent([], "s") == "s"
    assert silent([np.nan, np.inf], "s") == "s"
    assert silent([0, 4, 9], "us") == "us"
    assert silent(np.full(5000, 77), "us") == "us"


def test_a_jump_of_the_clock_does_not_change_the_rate():
    jumped = np.concatenate([TIMES_US[:1000], TIMES_US[1000:] + 3_000_000_000])
    assert silent(jumped, "us") == "us"
    plain, with_jump = (TimeNumbers.from_values(numbers, EVENTS.fewest) for numbers in (TIMES_US, jumped))
    assert with_jump.rate == pytest.approx(plain.rate, rel=0.2)


@pytest.mark.parametrize("unit", US_PER_UNIT)
def test_numbers_of_every_unit_become_microseconds(unit):
    expected = np.array([0, 1_000_000, 2_000_000, -1_000_000])
    numbers = np.rint(expected / US_PER_UNIT[unit])
    assert np.array_equal(whole_microseconds(numbers, unit, "file"), expected)
    assert np.array_equal(whole_microseconds(numbers.astype(np.int64), unit, "file"), expected)


def test_fractions_of_a_microsecond_are_rounded_halves_up():
    assert whole_microseconds(np.array([1.4, 1.5, 2.6]), "us", "file").tolist() == [1, 2, 3]
    assert whole_microseconds(np.array([1499, 1500, -1500, -1501]), "ns", "file").tolist() == [1, 2, -1, -2]
    assert whole_microseconds(np.array([2**64 - 1], np.uint64), "ns", "file").tolist() == [18446744073709552]


def test_times_that_are_none_are_refused():
    with pytest.raises(EventDataError, match="file: 2 times are not finite numbers"):
        whole_microseconds(np.array([0.0, np.nan, np.inf]), "s", "file")
    with pytest.raises(EventDataError, match=r"a time of 1e\+13 seconds does not fit 64 bits"):
        whole_microseconds(np.array([1e13]), "s", "file")
    with pytest.raises(EventDataError, match="does not fit 64 bits"):
        whole_microseconds(np.array([2**60]), "ms", "file")
    with pytest.raises(EventDataError, match="does not fit 64 bits"):
        whole_microseconds(np.array([2**64 - 1], np.uint64), "us", "file")

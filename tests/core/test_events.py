"""Events: batches, checks, and the windows a stream is cut into."""

import itertools

import numpy as np
import pytest
import torch
from helpers import random_events
from hypothesis import given, settings
from hypothesis import strategies as st

from torchtrack.core.events import EventBatch, check_events, concatenate, pad_streams
from torchtrack.core.windows import EventWindow, windows_by_count, windows_by_time
from torchtrack.errors import EventDataError

# The same examples in every run, however busy the machine is.
REPEATABLE = settings(deadline=None, derandomize=True)


def batch_at(times) -> EventBatch:
    """Events at these times; x counts them, so that each can be told from the others."""
    number = np.arange(len(times))
    return EventBatch.from_numpy(number, number % 7, np.asarray(times, dtype=np.int64), number % 2)


def chunks_of(events: EventBatch, cuts) -> list[EventBatch]:
    borders = [0, *sorted(cut % (len(events) + 1) for cut in cuts), len(events)]
    return [events[a:b] for a, b in itertools.pairwise(borders)]


def described(windows: list[EventWindow]) -> list[tuple]:
    return [(w.t_start_us, w.t_end_us, w.events.x.tolist()) for w in windows]


times = st.lists(st.integers(0, 400), max_size=60).map(sorted)
cut_places = st.lists(st.integers(0, 1000), max_size=5)
start_times = st.one_of(st.none(), st.integers(-50, 450))


# ---- EventBatch


@pytest.mark.parametrize("integer", [np.uint8, np.uint16, np.int32, np.int64, np.uint64, ">i4"])
def test_from_numpy_takes_any_integer_type(integer):
    x = np.array([1, 2, 3], dtype=integer)
    events = EventBatch.from_numpy(x, x, x, np.array([-1, -1, 1]), stream=4)
    assert events.x.dtype == events.y.dtype == torch.int32
    assert events.t_us.dtype == events.stream_index.dtype == torch.int64
    assert events.t_us.tolist() == [1, 2, 3]
    assert events.polarity.tolist() == [False, False, True]
    assert events.stream_index.tolist() == [4, 4, 4]


def test_from_numpy_takes_read_only_arrays():
    x = np.frombuffer(np.arange(3, dtype=np.int32).tobytes(), np.int32)
    on = np.frombuffer(bytes([0, 1, 1]), bool)
    events = EventBatch.from_numpy(x, x, x, on)
    assert events.x.tolist() == [0, 1, 2]
    assert events.polarity.tolist() == [False, True, True]


@pytest.mark.parametrize("values", [[-1, 0, 1], [1, 2, 1], [1, 255, 1], [0.0, 0.5, 1.0], [0, float("nan"), 1]])
def test_from_numpy_takes_no_other_codes_of_polarity(values):
    x = np.arange(3)
    with pytest.raises(EventDataError, match="polarity holds .*; expected 0 and 1, or -1 and 1"):
        EventBatch.from_numpy(x, x, x, np.array(values))


@pytest.mark.parametrize(
    ("x", "t_us", "message"),
    [
        ([1, 2], [1], "one length"),
        ([0.5], [1], "x must be integers"),
        ([1], [0.25], "t must be integers"),
        ([2**31], [1], "x must lie within"),
        ([1], np.array([2**63], dtype=np.uint64), "t must lie within"),
    ],
)
def test_from_numpy_refuses_what_does_not_fit(x, t_us, message):
    x = np.asarray(x)
    with pytest.raises(EventDataError, match=message):
        EventBatch.from_numpy(x, np.zeros(len(x), dtype=int), np.asarray(t_us), np.zeros(len(x)))


def test_empty_batch():
    assert len(EventBatch.empty()) == 0
    assert len(concatenate([])) == 0
    check_events(EventBatch.empty(), 1, 1)


def test_indexing_and_concatenation_undo_each_other():
    events = random_events(50)
    joined = concatenate([events[:20], events[20:20], events[20:]])
    for name in ("x", "y", "t_us", "polarity", "stream_index"):
        assert torch.equal(getattr(joined, name), getattr(events, name))
    assert torch.equal(events[events.polarity].t_us, events.t_us[events.polarity])


def test_of_stream_changes_the_stream_alone():
    events = random_events(10)
    moved = events.of_stream(3)
    assert moved.stream_index.tolist() == [3] * 10
    assert events.stream_index.tolist() == [0] * 10
    assert torch.equal(moved.x, events.x)


def test_to_moves_every_field(device):
    events = random_events(10).to(device)
    assert {getattr(events, name).device.type for name in ("x", "y", "t_us", "polarity", "stream_index")} == {device.type}


@REPEATABLE
@given(times, st.integers(-10, 410), st.integers(-10, 410))
def test_slice_time_is_half_open(t_us, start, end):
    inside = batch_at(t_us).slice_time(start, end)
    assert inside.t_us.tolist() == [t for t in t_us if start < t <= end]


# ---- check_events


@pytest.mark.parametrize(
    ("x", "y", "t_us", "message"),
    [
        ([1, 1, 1], [1, 1, 1], [5, 7, 6], r"recording: time goes back from 7 to 6 µs at event 2\."),
        ([1, 64, 1], [1, 1, 1], [5, 6, 7], r"event 1 is at \(64, 1\), outside the sensor of 64x48"),
        ([1, 1, 1], [1, 1, 48], [5, 6, 7], r"event 2 is at \(1, 48\)"),
        ([-1, 1, 1], [1, -1, 1], [5, 6, 7], r"event 0 is at \(-1, 1\).*\(2 such events\)"),
    ],
)
def test_check_events_names_the_event(x, y, t_us, message):
    events = EventBatch.from_numpy(np.array(x), np.array(y), np.array(t_us), np.zeros(3))
    with pytest.raises(EventDataError, match=message):
        check_events(events, 64, 48, "recording")


def test_check_events_compares_with_the_event_before_and_counts_on():
    events = batch_at([10, 11])
    check_events(events, 64, 48, last_t_us=10)
    with pytest.raises(EventDataError, match="from 12 to 10 µs at event 100"):
        check_events(events, 64, 48, last_t_us=12, first_index=100)


def test_events_at_one_time_are_sorted():
    check_events(batch_at([3, 3, 3]), 64, 48)


# ---- streams side by side


def test_padding_keeps_every_event_in_its_row():
    counts = [5, 0, 3]
    events = concatenate([random_events(count, seed=stream, stream=stream) for stream, count in enumerate(counts)])
    t_end_us = torch.tensor([20_000, 30_000, 40_000])
    padded = pad_streams(events, 3, t_end_us)
    assert padded.mask.sum(1).tolist() == counts
    for stream in range(3):
        own, row = events[events.stream_index == stream], padded.mask[stream]
        assert torch.equal(padded.x[stream][row].int(), own.x)
        assert torch.equal(padded.y[stream][row].int(), own.y)
        assert torch.equal(t_end_us[stream] - padded.age_us[stream][row], own.t_us)
        assert torch.equal(padded.polarity[stream][row], own.polarity)


def test_streams_that_are_mixed_up_are_an_error():
    events = concatenate([random_events(5, stream=1), random_events(3, stream=0)])
    with pytest.raises(EventDataError, match=r"after one of stream 1 there is one of stream 0 \(event 5\)"):
        pad_streams(events, 2, torch.tensor([20_000, 20_000]))


def test_padding_of_no_events():
    padded = pad_streams(EventBatch.empty(), 2, torch.tensor([0, 0]))
    assert padded.mask.shape[0] == 2
    assert not bool(padded.mask.any())


# ---- windows by time


@REPEATABLE
@given(times, cut_places, st.integers(1, 90), start_times)
def test_windows_by_time_hold_every_event_once(t_us, cuts, duration, start):
    events = batch_at(t_us)
    windows = list(windows_by_time(chunks_of(events, cuts), duration, start))
    first_start = start if start is not None else (t_us[0] - 1 if t_us else 0)
    held = [x for window in windows for x in window.events.x.tolist()]
    assert held == [i for i, t in enumerate(t_us) if t > first_start]
    for index, window in enumerate(windows):
        assert window.t_start_us == first_start + index * duration
        assert window.t_end_us == window.t_start_us + duration
        assert all(window.t_start_us < t <= window.t_end_us for t in window.events.t_us.tolist())
    if windows:
        assert len(windows[-1].events) > 0


@REPEATABLE
@given(times, cut_places, st.integers(1, 90), start_times)
def test_windows_by_time_do_not_depend_on_how_the_stream_is_cut(t_us, cuts, duration, start):
    events = batch_at(t_us)
    assert described(list(windows_by_time(chunks_of(events, cuts), duration, start))) == described(list(windows_by_time([events], duration, start)))


def test_windows_without_events_are_yielded():
    windows = list(windows_by_time([batch_at([1, 2, 41])], 10, 0))
    assert [(w.t_end_us, len(w.events)) for w in windows] == [(10, 2), (20, 0), (30, 0), (40, 0), (50, 1)]


def test_an_event_at_the_border_belongs_to_the_window_that_ends_there():
    windows = list(windows_by_time([batch_at([10, 11])], 10, 0))
    assert [w.events.t_us.tolist() for w in windows] == [[10], [11]]


def test_windows_are_made_as_the_stream_comes():
    """A window is there as soon as an event after its end is, and nothing is read ahead."""
    read = []

    def stream():
        for t_us in range(5, 1000, 10):
            read.append(t_us)
            yield batch_at([t_us])

    windows = windows_by_time(stream(), 20, 0)
    assert next(windows).t_end_us == 20
    assert read == [5, 15, 25]
    assert next(windows).t_end_us == 40
    assert read == [5, 15, 25, 35, 45]


# ---- windows by count


def expected_count_windows(t_us: list[int], count: int, max_age_us: int | None, start: int) -> list[tuple[int, int, list[int]]]:
    """The definition, event by event."""
    numbered = [(t, i) for i, t in enumerate(t_us) if t > start]
    windows = []
    while numbered:
        by_count = numbered[count - 1][0] if len(numbered) >= count else numbered[-1][0]
        end = by_count if max_age_us is None else min(by_count, start + max_age_us)
        windows.append((start, end, [i for t, i in numbered if t <= end]))
        numbered = [(t, i) for t, i in numbered if t > end]
        start = end
    return windows


@REPEATABLE
@given(times, cut_places, st.integers(1, 20), st.one_of(st.none(), st.integers(1, 60)), start_times)
def test_windows_by_count_follow_their_definition(t_us, cuts, count, max_age_us, start):
    events = batch_at(t_us)
    windows = list(windows_by_count(chunks_of(events, cuts), count, max_age_us, start))
    first_start = start if start is not None else (t_us[0] - 1 if t_us else 0)
    assert described(windows) == expected_count_windows(t_us, count, max_age_us, first_start)


def test_events_of_one_time_stay_together():
    windows = list(windows_by_count([batch_at([1, 2, 2, 2, 3])], 2))
    assert [w.events.t_us.tolist() for w in windows] == [[1, 2, 2, 2], [3]]


def test_maximum_age_closes_windows_early():
    windows = list(windows_by_count([batch_at([1, 2, 50, 51, 52])], 3, max_age_us=20, t_start_us=0))
    assert [(w.t_end_us, w.events.t_us.tolist()) for w in windows] == [(20, [1, 2]), (40, []), (52, [50, 51, 52])]


@pytest.mark.parametrize(
    "make",
    [
        lambda: windows_by_time([], 0),
        lambda: windows_by_count([], 0),
        lambda: windows_by_count([], 5, max_age_us=0),
    ],
)
def test_windows_of_no_extent_are_refused(make):
    with pytest.raises(EventDataError, match="window"):
        list(make())


# ---- silence


@pytest.mark.parametrize("silent_us", [3_600_000_000, 10**15])
def test_long_silence_is_passed_over(silent_us):
    times = [1, 2, 41, silent_us, silent_us + 12_000]
    windows = list(windows_by_time([batch_at(times)], 10_000, 0))
    assert len(windows) == 53
    assert all(window.t_end_us - window.t_start_us == 10_000 for window in windows)
    assert [number for number, window in enumerate(windows) if window.after_gap] == [51]
    assert [(w.t_start_us, w.events.t_us.tolist()) for w in windows[-2:]] == [
        (silent_us - 1, [silent_us]),
        (silent_us + 9_999, [silent_us + 12_000]),
    ]


def test_silence_before_the_first_event_is_passed_over():
    windows = list(windows_by_time([batch_at([7_000_000])], 500_000, 0))
    assert [(w.t_start_us, w.after_gap) for w in windows] == [(0, False), (6_999_999, True)]


@pytest.mark.parametrize("max_age_us", [None, 10_000])
def test_long_silence_ends_a_window_by_count(max_age_us):
    times = [1, 2, 3, 3_000_000_000, 3_000_000_001, 3_000_000_002]
    windows = list(windows_by_count([batch_at(times[:2]), batch_at(times[2:])], 2, max_age_us, 0))
    with_events = [(w.t_start_us, w.events.t_us.tolist(), w.after_gap) for w in windows if len(w.events)]
    assert [events for _, events, _ in with_events] == [[1, 2], [3], times[3:5], times[5:]]
    assert with_events[2] == (2_999_999_999, times[3:5], True)
    assert len(windows) <= 55
    assert all(window.t_end_us - window.t_start_us <= 10_000 for window in windows)


def test_windows_by_count_start_where_events_are():
    windows = list(windows_by_count([batch_at([5_000_000, 5_000_001])], 2, None, 0))
    assert [(w.t_start_us, w.t_end_us, w.after_gap) for w in windows] == [(4_999_999, 5_000_001, True)]

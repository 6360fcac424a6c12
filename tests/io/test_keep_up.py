"""A tracker behind a live stream follows all of it, by fewer and longer windows; what is left out is counted."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_events
from tracked_boxes import WINDOW_US, moving_box
from tracked_boxes import windows as cut

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.haste import in_haste
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.core.windows import EventWindow
from torchtrack.io.keep_up import FEWEST_EVENTS, LONGEST_US, MOST_JOINED, HastyWindow, WaitingWindows
from torchtrack.run.haste import Pace
from torchtrack.tracking.validation.status import Status

CAPACITY = 64


def window(number: int, count: int = 10, duration_us: int = 1000) -> EventWindow:
    events = random_events(count, seed=number)
    start_us, end_us = number * duration_us, (number + 1) * duration_us
    t_us = torch.linspace(start_us + 1, end_us, count).long()
    return EventWindow(replace(events, t_us=t_us), start_us, end_us)


def counts(waiting: WaitingWindows) -> tuple[int, int, int]:
    """Joined and dropped windows, and events left out."""
    return waiting.joined_windows, waiting.dropped_windows, waiting.dropped_events


# ---- windows that wait


def test_a_window_that_waits_alone_is_taken_as_it_is():
    waiting = WaitingWindows(5)
    for number in range(200):
        waiting.put(single := window(number))
        taken = waiting.take()
        assert (taken.events, taken.t_start_us, taken.t_end_us) == (single.events, single.t_start_us, single.t_end_us)
    assert taken is single
    assert counts(waiting) == (0, 0, 0)


def came(waiting: WaitingWindows, first: int, count: int, events: int = 10) -> EventWindow:
    """What is taken after so many more windows."""
    for number in range(first, first + count):
        waiting.put(window(number, events))
    return waiting.take()


def test_at_a_constant_speed_as_many_are_joined_as_come_during_a_step():
    waiting = WaitingWindows(50)
    came(waiting, 0, 1)
    taken = [came(waiting, first, 4) for first in range(1, 61, 4)]
    assert [taken_window.t_end_us - taken_window.t_start_us for taken_window in taken[4:]] == [4000] * 11
    assert len(waiting) <= 8


def test_after_a_pause_what_waits_is_caught_up_with_by_few_more_at_a_time():
    waiting = WaitingWindows(50)
    taken = [came(waiting, 0, 1), came(waiting, 1, 31)]
    first = 32
    while waiting:
        taken.append(came(waiting, first, 1))
        first += 1
    lengths = [(taken_window.t_end_us - taken_window.t_start_us) // 1000 for taken_window in taken]
    assert lengths[:4] == [1, 2, 4, 5]
    assert max(lengths) == 5
    assert lengths[-1] <= 2
    assert [taken_window.t_start_us for taken_window in taken] == [0, *(taken_window.t_end_us for taken_window in taken[:-1])]
    assert counts(waiting) == (first - len(taken), 0, 0)


def test_no_more_are_joined_than_a_bound_and_than_twice_as_many_as_before():
    waiting = WaitingWindows(500)
    taken = [came(waiting, first, 20) for first in range(0, 100, 20)]
    assert [(taken_window.t_end_us - taken_window.t_start_us) // 1000 for taken_window in taken] == [2, 4, 8, MOST_JOINED, MOST_JOINED]


def test_joined_windows_have_as_many_events_as_one_spread_evenly_with_the_newest():
    waiting = WaitingWindows(50)
    came(waiting, 0, 2)
    events = came(waiting, 2, 4, 3 * FEWEST_EVENTS).events
    assert len(events) == 3 * FEWEST_EVENTS
    assert waiting.dropped_events == 9 * FEWEST_EVENTS
    assert int(events.t_us[-1]) == 6000
    of_each = torch.bincount((events.t_us - 2001) // 1000)
    assert bool(((of_each - 0.75 * FEWEST_EVENTS).abs() <= 1).all())
    # Few events are all kept, in order.
    few = came(waiting, 6, 4)
    assert len(few.events) == 40
    assert bool((torch.diff(few.events.t_us) >= 0).all())


def test_of_too_many_the_oldest_are_joined_and_no_time_is_lost():
    waiting = WaitingWindows(5)
    for number in range(100):
        waiting.put(window(number))
        assert len(waiting) <= 5
    taken = []
    while waiting:
        taken.append(waiting.take())
    assert [taken_window.t_start_us for taken_window in taken] == [0, *(taken_window.t_end_us for taken_window in taken[:-1])]
    assert taken[-1].t_end_us == 100_000
    assert (waiting.joined_windows, waiting.dropped_windows, waiting.dropped_events) == (100 - len(taken), 0, 0)


def test_what_has_waited_for_very_long_is_dropped_whole_and_counted():
    waiting = WaitingWindows(2)
    for number in range(6):
        waiting.put(window(number, duration_us=LONGEST_US // 2))
    only = waiting.take()
    assert (only.t_start_us, only.t_end_us) == (2 * LONGEST_US, 3 * LONGEST_US)
    # Two of two windows each; and every window is tracked, joined with the next, or dropped.
    assert counts(waiting) == (3, 2, 40)


def test_a_start_is_in_haste_and_haste_ends_a_while_after_the_last_joined_window():
    waiting = WaitingWindows(5)
    taken = [came(waiting, number, 1) for number in range(150)]
    taken.append(came(waiting, 150, 2))
    taken += [came(waiting, number, 1) for number in range(152, 400)]
    hasty = [taken_window.t_end_us for taken_window in taken if isinstance(taken_window, HastyWindow)]
    assert hasty == [*range(1000, 102_000, 1000), 152_000, *range(153_000, 253_000, 1000)]


# ---- who tracks them


def test_in_haste_no_other_poses_are_tried_and_few_to_find_what_is_lost():
    usual = TrackerConfig()
    none, few = (in_haste(usual, searches=searches) for searches in (False, True))
    assert none.relocalization.hypotheses == 0
    assert 0 < few.relocalization.hypotheses < usual.relocalization.hypotheses
    assert few.relocalization.rotations < usual.relocalization.rotations
    assert not few.uses(Component.LOW_SCORE)
    assert few.relocalization.slow_drift_below == few.relocalization.new_below == 0
    assert not none.uses(Component.WINDOW_PARTS) and not few.uses(Component.WINDOW_PARTS)
    assert none.association == few.association == usual.association


def test_what_is_lost_is_searched_for_once_in_a_while():
    tracker = Tracker([box_model()], SMALL_CAMERA)
    pace = Pace(tracker)
    _, result = tracker.step(tracker.init(pose()[None], 0), EventBatch.empty(), WINDOW_US)
    seen = replace(result, status=torch.full_like(result.status, int(Status.TRACKING)))
    lost = replace(result, status=torch.full_like(result.status, int(Status.LOST)))

    def hypotheses(end_us: int, before) -> int:
        return pace.tracker([HastyWindow(EventBatch.empty(), end_us - WINDOW_US, end_us)], before).config.relocalization.hypotheses

    assert pace.tracker([EventWindow(EventBatch.empty(), 0, WINDOW_US)], lost) is tracker
    assert hypotheses(WINDOW_US, None) == hypotheses(2 * WINDOW_US, seen) == 0
    assert hypotheses(3 * WINDOW_US, lost) > 0
    assert hypotheses(4 * WINDOW_US, lost) == 0
    assert hypotheses(500_000 + 3 * WINDOW_US, lost) > 0


# ---- all of it, by a clock that is made up: a step takes as long as so many windows


@pytest.mark.parametrize("windows_a_step", [1, 2, 4])
def test_a_slow_tracker_follows_the_whole_stream_with_a_bounded_lag(windows_a_step):
    count = 120
    trajectory, events = moving_box(pose(), count)
    stream = [EventWindow(batch, end_us - WINDOW_US, end_us) for batch, end_us in cut(events, count)]
    tracker = Tracker([box_model()], SMALL_CAMERA)
    pace, state, result = Pace(tracker), tracker.init(pose()[None], 0), None
    waiting, came, now_us, tracked_us, lags_us = WaitingWindows(CAPACITY), 0, 0, 0, []
    with torch.inference_mode():
        while came < count or waiting:
            while came < count and (stream[came].t_end_us <= now_us or not waiting):
                now_us = max(now_us, stream[came].t_end_us)
                waiting.put(stream[came])
                came += 1
            taken_window = waiting.take()
            state, result = pace.tracker([taken_window], result).step(state, taken_window.events, taken_window.t_end_us)
            now_us += windows_a_step * WINDOW_US
            lags_us.append(now_us - taken_window.t_end_us)
            T_found = result.T_cam_obj[0]
            true = trajectory.at(torch.tensor([taken_window.t_end_us]))[0]
            if result.status[0] <= int(Status.UNCERTAIN) and rotation_angle_deg(T_found[:3, :3], true[:3, :3]) < 2:
                tracked_us += taken_window.t_end_us - taken_window.t_start_us
    assert tracked_us >= 0.95 * count * WINDOW_US
    assert max(lags_us) <= (CAPACITY + windows_a_step) * WINDOW_US
    assert waiting.dropped_windows == 0
    assert len(lags_us) + waiting.joined_windows == count

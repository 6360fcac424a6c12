"""A tracker behind a live stream follows all of it, by fewer and longer windows; what is left out is counted."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_events
from tracked_boxes import WINDOW_US, moving_box
from tracked_boxes import windows as cut

from torchtrack import Tracker
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
    for number in range(3):
        waiting.put(one := window(number))
        assert waiting.take() is one
    assert counts(waiting) == (0, 0, 0)


def test_what_waits_is_taken_as_one():
    waiting = WaitingWindows(50)
    for number in range(MOST_JOINED + 3):
        waiting.put(window(number))
    first, second = waiting.take(), waiting.take()
    assert not waiting
    assert (first.t_start_us, first.t_end_us, second.t_start_us, second.t_end_us) == (0, 12_000, 12_000, 15_000)
    # Few events are all kept, in order.
    assert len(first.events) == 10 * MOST_JOINED
    assert len(second.events) == 30
    assert bool((torch.diff(first.events.t_us) >= 0).all())
    assert counts(waiting) == (MOST_JOINED - 1 + 2, 0, 0)


def test_joined_windows_have_as_many_events_as_one_spread_evenly_with_the_newest():
    waiting = WaitingWindows(50)
    for number in range(4):
        waiting.put(window(number, 3 * FEWEST_EVENTS))
    events = waiting.take().events
    assert len(events) == 3 * FEWEST_EVENTS
    assert waiting.dropped_events == 9 * FEWEST_EVENTS
    assert int(events.t_us[-1]) == 4000
    of_each = torch.bincount((events.t_us - 1) // 1000)
    assert bool(((of_each - 0.75 * FEWEST_EVENTS).abs() <= 1).all())


def test_of_too_many_the_oldest_are_joined_and_no_time_is_lost():
    waiting = WaitingWindows(5)
    for number in range(100):
        waiting.put(window(number))
        assert len(waiting) <= 5
    only = waiting.take()
    assert (only.t_start_us, only.t_end_us) == (0, 100_000)
    assert (waiting.joined_windows, waiting.dropped_windows, waiting.dropped_events) == (99, 0, 0)


def test_what_has_waited_for_very_long_is_dropped_whole_and_counted():
    waiting = WaitingWindows(2)
    for number in range(6):
        waiting.put(window(number, duration_us=LONGEST_US // 2))
    only = waiting.take()
    assert (only.t_start_us, only.t_end_us) == (2 * LONGEST_US, 3 * LONGEST_US)
    # Two of two windows each; and every window is tracked, joined with the next, or dropped.
    assert counts(waiting) == (3, 2, 40)


def test_haste_ends_a_while_after_the_last_joined_window():
    waiting = WaitingWindows(5)
    waiting.put(window(0))
    waiting.put(window(1))
    taken = [waiting.take()]
    for number in range(2, 200):
        waiting.put(window(number))
        taken.append(waiting.take())
    hasty = [one.t_end_us for one in taken if isinstance(one, HastyWindow)]
    assert hasty == [2000, *range(3000, 103_000, 1000)]


# ---- who tracks them


def test_in_haste_no_other_poses_are_tried_and_few_to_find_what_is_lost():
    usual = TrackerConfig()
    none, few = (in_haste(usual, searches=searches) for searches in (False, True))
    assert none.search.hypotheses == 0
    assert 0 < few.search.hypotheses < usual.search.hypotheses
    assert few.search.drawn < usual.search.drawn
    assert not few.search.at_start
    assert none.window.parts == few.window.parts == 2
    assert none.matching == few.matching == usual.matching
    alone = usual.model_copy(update={"window": usual.window.model_copy(update={"parts": 1})})
    assert in_haste(alone, searches=False).window.parts == 1


def test_what_is_lost_is_searched_for_once_in_a_while():
    tracker = Tracker([box_model()], SMALL_CAMERA)
    pace = Pace(tracker)
    _, result = tracker.step(tracker.init(pose()[None], 0), EventBatch.empty(), WINDOW_US)
    seen = replace(result, status=torch.full_like(result.status, int(Status.TRACKING)))
    lost = replace(result, status=torch.full_like(result.status, int(Status.LOST)))

    def hypotheses(end_us: int, before) -> int:
        return pace.tracker([HastyWindow(EventBatch.empty(), end_us - WINDOW_US, end_us)], before).config.search.hypotheses

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
            one = waiting.take()
            state, result = pace.tracker([one], result).step(state, one.events, one.t_end_us)
            # Parts of a window are steps, too.
            now_us += windows_a_step * WINDOW_US * (2 if isinstance(one, HastyWindow) else 1)
            lags_us.append(now_us - one.t_end_us)
            found = result.T_cam_obj[0]
            true = trajectory.at(torch.tensor([one.t_end_us]))[0]
            if result.status[0] <= int(Status.UNCERTAIN) and rotation_angle_deg(found[:3, :3], true[:3, :3]) < 2:
                tracked_us += one.t_end_us - one.t_start_us
    assert tracked_us >= 0.95 * count * WINDOW_US
    assert max(lags_us) <= (CAPACITY + 2 * windows_a_step) * WINDOW_US
    assert waiting.dropped_windows == 0
    assert len(lags_us) + waiting.joined_windows == count

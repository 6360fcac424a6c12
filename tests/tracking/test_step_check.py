"""A step refuses events out of time order, older than its state, or after its window, and says which stream."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_events
from tracked_boxes import tensors_of

from torchtrack import Tracker
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError
from torchtrack.tracking.step_check import check_step


def events_at(times_us, stream: int = 0) -> EventBatch:
    events = random_events(len(times_us), seed=len(times_us), width=SMALL_CAMERA.width, height=SMALL_CAMERA.height)
    return replace(events, t_us=torch.tensor(times_us, dtype=torch.int64), stream_index=torch.full((len(times_us),), stream))


BOUNDS = (torch.tensor([1000, 5000]), torch.tensor([2000, 6000]))


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ([1500, 1400, 1600], [5100], r"stream 0: time goes back from 1500 to 1400 µs at event 1\. Sort"),
        ([1500, 1600], [5100, 5200, 5150], r"stream 1: time goes back from 5200 to 5150 µs at event 4\. Sort"),
        ([999, 1500], [5100], r"stream 0: an event of 999 µs is older than the state, which is of 1000 µs\. Give each event once"),
        ([1500], [4000, 5100], r"stream 1: an event of 4000 µs is older than the state, which is of 5000 µs"),
        ([], [5100, 6001], r"stream 1: an event of 6001 µs is after the window's end at 6000 µs\. Cut the events"),
    ],
)
def test_what_is_refused(first, second, message):
    with pytest.raises(EventDataError, match=message):
        check_step(BOUNDS[0], concatenate([events_at(first, 0), events_at(second, 1)]), BOUNDS[1])


def test_what_is_taken():
    # At the very time of the state, at the window's end, at one time, of one stream alone, and of no stream.
    for first, second in [([1000, 1000, 2000], [5000, 6000]), ([], [5100]), ([1100], []), ([], [])]:
        check_step(BOUNDS[0], concatenate([events_at(first, 0), events_at(second, 1), events_at([7, 3], 2)]), BOUNDS[1])


def test_a_window_before_the_state():
    with pytest.raises(EventDataError, match=r"stream 1: the window ends at 4999 µs, before the state, which is of 5000 µs"):
        check_step(BOUNDS[0], EventBatch.empty(), torch.tensor([2000, 4999]))


def test_a_step_refuses_them_and_leaves_the_state_alone():
    tracker = Tracker([box_model()], SMALL_CAMERA)
    state = tracker.init(pose()[None], 1000)
    before = [tensor.clone() for tensor in tensors_of(state)]
    for times_us in ([1500, 1400], [900, 1500]):
        with pytest.raises(EventDataError, match="stream 0"):
            tracker.step(state, events_at(times_us))
    with pytest.raises(EventDataError, match="after the window's end"):
        tracker.step(state, events_at([1500]), 1400)
    assert all(torch.equal(*pair) for pair in zip(tensors_of(state), before, strict=True))
    assert int(tracker.step(state, events_at([1000, 1400]))[0].t_us) == 1400

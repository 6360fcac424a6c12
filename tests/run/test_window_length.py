"""Windows in mode 'adaptive': as long as the fastest object of a stream takes to move on by some pixels."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model
from pydantic import ValidationError
from tiny_sequence import write_tiny_sequence

from torchtrack import Tracker
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import se3_exp
from torchtrack.run.runner import track
from torchtrack.run.session import open_session
from torchtrack.run.streams import build_tracker
from torchtrack.run.window_length import WindowLength, contour_speed, next_window_us, tell_lengths
from torchtrack.tracking.validation.status import Status

DEPTH_M, WINDOW_US = 0.5, 5000
ADAPTIVE = WindowConfig(mode="adaptive", motion_px=1.0, duration_us=6000, shortest_us=2000, longest_us=20_000)


def after_window(speeds_px_s, stream_index=None, status=Status.TRACKING):
    """Tracker, state before a window, and its result, of boxes that moved to the right in it."""
    count, stream_index = len(speeds_px_s), stream_index or [0] * len(speeds_px_s)
    tracker = Tracker([box_model()] * count, [SMALL_CAMERA] * (max(stream_index) + 1), stream_index=stream_index)
    T_after = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T_after[:, 2, 3] = DEPTH_M
    back = torch.zeros(count, 6, dtype=torch.float64)
    # The front of the box is a little nearer than its centre.
    back[:, 3] = -1e-6 * WINDOW_US * torch.tensor(speeds_px_s, dtype=torch.float64) * DEPTH_M / SMALL_CAMERA.fx
    state = tracker.init(se3_exp(back) @ T_after, 0)
    _, result = tracker.step(state, EventBatch.empty(), WINDOW_US)
    contours = tracker.objects.contours(T_after.float(), tracker.config.contours)
    return tracker, state, replace(result, T_cam_obj=T_after, contours=contours, status=torch.full((count,), int(status)))


def test_speed_is_that_of_the_contours_in_the_image():
    speed = contour_speed(*after_window([30.0, 300.0, 3000.0]))
    torch.testing.assert_close(speed, torch.tensor([30.0, 300.0, 3000.0]), rtol=0.15, atol=0)


@pytest.mark.parametrize(("speed_px_s", "expected_us"), [(0.0, 20_000), (10.0, 20_000), (200.0, 5000), (2000.0, 2000)])
def test_a_window_lasts_until_contours_have_moved_on_within_bounds(speed_px_s, expected_us):
    lengths_us = next_window_us(*after_window([speed_px_s]), ADAPTIVE)
    assert lengths_us.tolist() == [pytest.approx(expected_us, rel=0.15)]


def test_the_fastest_object_of_each_stream_decides():
    lengths_us = next_window_us(*after_window([100.0, 200.0, 10.0], [0, 0, 1]), ADAPTIVE)
    assert lengths_us.tolist() == [pytest.approx(5000, rel=0.15), 20_000]


@pytest.mark.parametrize("status", [Status.LOST, Status.TOO_FEW_EVENTS, Status.DIVERGED])
def test_while_an_object_is_not_followed_windows_are_as_usual(status):
    assert next_window_us(*after_window([10.0], status=status), ADAPTIVE).tolist() == [6000]


@pytest.mark.parametrize("mode", ["time", "count"])
def test_in_other_modes_nothing_is_told(mode):
    length = WindowLength(WindowConfig(mode=mode, duration_us=3000))
    tell_lengths([length], *after_window([2000.0]))
    assert length() == 3000


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return RunConfig(source=write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=60_000))


def test_the_same_settings_give_short_windows_to_the_fast_and_long_ones_to_the_slow(tiny):
    """The box moves by about 33 px/s: 2 px take longer than any window, 0.1 px about 3 ms."""
    session = open_session(tiny)
    tracker = build_tracker([session], tiny)
    state = tracker.init(session.T_cam_obj, session.start_us)
    spans = {}
    for motion_px in (0.1, 2.0):
        window = WindowConfig(mode="adaptive", motion_px=motion_px, duration_us=6000, shortest_us=1000, longest_us=9000)
        ends_us = torch.cat([result.t_us for result in track(session.events, tracker, state, window)])
        spans[motion_px] = torch.diff(ends_us, prepend=torch.tensor([session.start_us]))
    assert spans[0.1][0] == spans[2.0][0] == 6000
    assert (spans[2.0][1:] == 9000).all()
    assert 2000 < spans[0.1][2:].double().median() < 4500


def test_lengths_must_be_in_order():
    with pytest.raises(ValidationError, match=r"longest_us \(1000\) must not be less than shortest_us \(2000\)"):
        WindowConfig(mode="adaptive", shortest_us=2000, longest_us=1000)

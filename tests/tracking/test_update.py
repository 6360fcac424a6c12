"""The end of a window: where objects go on from, when hardly anything fires."""

from dataclasses import replace

import pytest
from helpers import SMALL_CAMERA, edge_events, pose, pose_errors, random_events
from printed_plate import starting
from tracked_boxes import WINDOW_US, follow, merged, poses_of, tracker_of, windows

from torchtrack.tracking.validation.status import Status

STOPS_US, GOES_ON_US, END_US = 200_000, 400_000, 600_000


def stop_and_go(slows_us):
    """Trajectories of a box that slows down within a time and stops, and of its going on; and all events."""
    going = starting(END_US - GOES_ON_US, turn=(0.8, -0.5, 1.2), move=(0.15, 0.1, 0.1), T_start=pose(), until_full_us=slows_us)
    # Backwards in time, what gains speed slows down.
    stopping = replace(going, T_cam_obj=going.T_cam_obj.flip(0))
    going = replace(going, t_us=going.t_us + GOES_ON_US)
    return stopping, going, merged(edge_events(stopping, SMALL_CAMERA), edge_events(going, SMALL_CAMERA, seed=1))


@pytest.mark.parametrize("noise", [0, 30])
@pytest.mark.parametrize("slows_us", [1, 100_000])
def test_an_object_that_stops_stays_where_it_stopped_and_is_tracked_once_it_goes_on(slows_us, noise):
    stopping, going, events = stop_and_go(slows_us)
    count = END_US // WINDOW_US
    if noise:
        size = {"width": SMALL_CAMERA.width, "height": SMALL_CAMERA.height}
        events = merged(random_events(noise * count, duration_us=END_US, **size), events)
    tracker = tracker_of()
    _, results = follow(tracker, tracker.init(stopping.T_cam_obj[:1], 0), windows(events, count))
    at_rest = [result for result in results if STOPS_US < int(result.t_us) <= GOES_ON_US]
    assert {int(result.status) for result in at_rest} == {Status.TOO_FEW_EVENTS}
    degrees, millimetres = pose_errors(poses_of(at_rest), going.T_cam_obj[:1])
    assert float(degrees.max()) < 1.2
    assert float(millimetres.max()) < 2.5
    degrees, _ = pose_errors(results[-1].T_cam_obj, going.T_cam_obj[-1:])
    assert float(degrees) < 0.5
    assert int(results[-1].status) == Status.TRACKING

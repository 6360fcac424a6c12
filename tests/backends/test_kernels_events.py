"""What each object sees of a window's events is the same by kernels, which choose, date and divide them in two passes."""

from dataclasses import replace

import pytest
import torch
from both_ways import both_ways
from helpers import SMALL_CAMERA, box_model, generator, pose, random_events

from torchtrack import Tracker
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.frontend.bursts import LONG_AGO_US
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.window_events import SharedEvents, WindowEvents
from torchtrack.tracking.initialization import first_state

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
BENT_CAMERA = replace(SMALL_CAMERA, distortion_model="plumb_bob", distortion=(-0.2, 0.05, 0.001, -0.002, 0.0))
# Places of boxes (m), of which the last is far from the others.
PLACES_M = ((0.0, 0.0, 0.5), (0.02, -0.03, 0.6), (-0.06, 0.03, 0.9), (5.0, 0.0, 0.5))


def window_of(objects: int, count: int, window_us: int, camera: Camera = SMALL_CAMERA, streams: int = 1):
    """How a window's events come to be what each of some boxes sees, which look at streams in turn: a function for both ways."""
    stream_index = [number % streams for number in range(objects)]
    tracker = Tracker([box_model()] * objects, [camera] * streams, stream_index=stream_index, dtype=torch.float64)
    T_cam_obj = pose().repeat(objects, 1, 1)
    T_cam_obj[:, :3, 3] = torch.tensor(PLACES_M[:objects]).double()
    state = first_state(tracker, T_cam_obj, torch.zeros(streams, dtype=torch.int64))
    ages = torch.randint(LONG_AGO_US, state.maps.burst_age_us.shape, generator=generator(1), dtype=torch.int16)
    # The second of three streams has no events.
    with_events = [stream for stream in range(streams) if stream != 1 or streams < 3]
    size = {"width": camera.width, "height": camera.height, "duration_us": window_us - 1}
    batches = [random_events(count, **size, seed=stream, stream=stream) for stream in with_events]
    events = concatenate(batches) if count else EventBatch.empty()
    t_us, dt_s = torch.full((streams,), window_us), torch.full((objects,), 1e-6 * window_us).double()
    prediction, sensors = predicted_after(tracker, state, dt_s), tracker.sensors

    def seen():
        nearby = sensors.near_objects(NearbyEvents(events), prediction, dt_s, tracker.config)
        return sensors.window_events(nearby, ages, t_us, t_us)

    return tracker, events, prediction, seen


def entries_of(events: WindowEvents, number: int) -> dict[str, torch.Tensor]:
    """What there is of the events of one object, by the name of what is told."""
    own = {name: value[number, events.mask[number]] for name, value in vars(events).items() if value is not None}
    return own if "number" in own else own | {"number": torch.arange(events.mask.shape[1])[events.mask[number]]}


@pytest.mark.parametrize(("objects", "streams"), [(1, 1), (2, 1), (4, 1), (2, 2), (4, 3), (1, 2)])
@pytest.mark.parametrize(("count", "window_us"), [(6000, 5000), (60, 5000), (6000, 2 * LONG_AGO_US), (0, 5000)])
@pytest.mark.parametrize("camera", [SMALL_CAMERA, BENT_CAMERA], ids=["straight", "bent"])
def test_what_each_object_sees_of_a_window(objects, streams, count, window_us, camera):
    _, _, _, seen = window_of(objects, count, window_us, camera, streams)
    (ours, ages), (theirs, plain_ages) = both_ways(seen)
    if streams == 1:
        assert torch.equal(ages, plain_ages)
    for number in range(objects):
        by_kernel, plain = (entries_of(events.rows(), number) for events in (ours, theirs))
        assert by_kernel.keys() == plain.keys()
        for name, value in plain.items():
            torch.testing.assert_close(by_kernel[name], value, rtol=0, atol=1e-15)
        assert int(ours.counts()[number]) == len(plain["age_s"])


def test_events_of_several_objects_are_not_copied_for_each():
    _, _, _, seen = window_of(4, 6000, 5000)
    with torch.inference_mode():
        events, _ = seen()
    assert isinstance(events, SharedEvents)
    assert events.shared.mask.shape[0] == 1
    for number in range(4):
        single, row = entries_of(events.of_objects(torch.tensor([number])), 0), entries_of(events.rows(), number)
        assert all(torch.equal(single[name], row[name]) for name in row)
    assert int(events.counts()[3]) == 0
    assert not events.of_objects(torch.tensor([3])).mask.any()
    some = events.of_objects(torch.tensor([2, 0]))
    for row, number in enumerate((2, 0)):
        single, own = entries_of(some, row), entries_of(events.rows(), number)
        assert all(torch.equal(single[name], own[name]) for name in own)


@pytest.mark.parametrize("count", [100, 5000])
def test_of_shared_events_those_are_chosen_that_would_be_of_rows(count):
    tracker, _, prediction, seen = window_of(3, 6000, 5000)
    with torch.inference_mode():
        events, _ = seen()
        contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
        index, moving = index_contours(contours, tracker.image_size, 7, 2), prediction.moving(compensated=True)
        shared, rows = (select_events(each, index, moving, count) for each in (events, events.rows()))
    assert int(shared.mask.sum()) > 0
    assert torch.equal(shared.mask, rows.mask)
    for name in ("pixels", "age_s", "polarity"):
        assert torch.equal(getattr(shared, name)[shared.mask], getattr(rows, name)[rows.mask])


def test_events_of_no_stream_are_not_seen():
    tracker, events, prediction, _ = window_of(2, 500, 5000)
    beyond = replace(events, stream_index=torch.full_like(events.stream_index, 3))
    dt_s, t_us = torch.full((2,), 5e-3).double(), torch.tensor([5000])
    ages = tracker.init(pose().expand(2, 4, 4), 0).maps.burst_age_us
    with torch.inference_mode():
        counts = []
        for batch in (events, concatenate([events, beyond])):
            nearby = tracker.sensors.near_objects(NearbyEvents(batch), prediction, dt_s, tracker.config)
            seen, _ = tracker.sensors.window_events(nearby, ages, t_us, t_us)
            counts.append(seen.counts())
    assert torch.equal(*counts)

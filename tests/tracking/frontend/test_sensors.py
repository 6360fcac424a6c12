"""What each object's camera saw: events in ideal pixels and back on the sensor, and when anything last happened there."""

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose

from torchtrack import Tracker
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, pad_streams
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.time_surface import empty_last_event, update_last_event

BENT = Camera(180.0, 185.0, 70.0, 60.0, 160, 120, "plumb_bob", (-0.3, 0.1, 0.002, -0.001))
NOW_US = torch.tensor([5000, 9000])


@pytest.fixture
def sensors():
    """Two streams of different cameras; the first object is seen in the second stream."""
    return Tracker([box_model()] * 3, [SMALL_CAMERA, BENT], stream_index=[1, 0, 0], dtype=torch.float64).sensors


@pytest.fixture
def events():
    """Two events of the first stream, and one of the second."""
    return EventBatch(
        x=torch.tensor([10, 140, 30], dtype=torch.int32),
        y=torch.tensor([20, 100, 110], dtype=torch.int32),
        t_us=torch.tensor([1000, 4000, 7000]),
        polarity=torch.tensor([True, False, True]),
        stream_index=torch.tensor([0, 0, 1]),
    )


def test_each_object_sees_the_events_of_its_stream(sensors, events):
    seen = sensors.seen(pad_streams(events, 2, NOW_US))
    assert seen.mask.sum(-1).tolist() == [1, 2, 2]
    torch.testing.assert_close(seen.age_s[seen.mask], torch.tensor([2e-3, 4e-3, 1e-3, 4e-3, 1e-3], dtype=torch.float64))
    assert seen.polarity[seen.mask].tolist() == [1, 1, -1, 1, -1]
    assert seen.number is None
    ideal = [sensors.ideal_pixels[stream, y, x] for stream, y, x in ((1, 110, 30), (0, 20, 10), (0, 100, 140), (0, 20, 10), (0, 100, 140))]
    assert torch.equal(seen.pixels[seen.mask], torch.stack(ideal))


def test_the_lens_puts_ideal_pixels_back_where_they_were_seen(sensors, events):
    seen = sensors.seen(pad_streams(events, 2, NOW_US))
    back = sensors.on_sensor(seen.pixels)[seen.mask]
    # Looked up for whole ideal pixels: no nearer than half of one.
    assert float((back - torch.tensor([[30, 110], [10, 20], [140, 100], [10, 20], [140, 100]])).abs().max()) < 0.75


def test_pixels_far_off_are_somewhere_outside(sensors):
    far = torch.tensor([[[1e12, -1e12], [-1e12, 1e12]]], dtype=torch.float64).expand(3, 2, 2)
    place = sensors.on_sensor(far)
    assert torch.isfinite(place).all()
    height, width = sensors.image_size
    assert not ((place >= 0) & (place < torch.tensor([width, height]))).all(-1).any()


def test_numbers_are_those_of_the_sensor_pixels_nearest_to_ideal_ones(sensors):
    height, width = sensors.image_size
    nearest = sensors.sensor_pixels.round()
    column, row = nearest[..., 0].clamp(0, width - 1).long(), nearest[..., 1].clamp(0, height - 1).long()
    assert sensors.sensor_numbers.shape == sensors.sensor_pixels.shape[:3]
    assert torch.equal(sensors.sensor_numbers.long(), row * width + column)


def test_the_history_looks_where_the_lens_puts_an_ideal_pixel(sensors):
    height, width = sensors.image_size
    # An age for every sensor pixel, of no other: what is looked up tells where it was.
    last_event_us = -torch.arange(2 * height * width).view(2, height, width)
    pixels = torch.tensor([[[20.0, 30.0], [150.0, 5.0], [80.4, 99.6]]], dtype=torch.float64).expand(3, 3, 2)
    u, v = sensors.on_sensor(pixels).round().unbind(-1)
    number = (v.clamp(0, height - 1) * width + u.clamp(0, width - 1)).long() + sensors.stream_index[:, None] * height * width
    age_s = sensors.history(last_event_us, torch.tensor([0, 0])).age_s(pixels)
    torch.testing.assert_close(age_s, 1e-6 * number.double())


def test_the_history_tells_the_age_of_the_newest_event(sensors, events):
    last_event_us = update_last_event(empty_last_event(2, *sensors.image_size), events)
    age_s = sensors.history(last_event_us, NOW_US).age_s
    # The straight camera's pixels are ideal ones.
    ages = age_s(torch.tensor([[[10.2, 19.8], [50.0, 50.0]]], dtype=torch.float64).expand(3, 2, 2))
    torch.testing.assert_close(ages[1:, 0], torch.tensor([4e-3, 4e-3], dtype=torch.float64))
    assert (ages[:, 1] > 1e6).all() and float(ages[0, 0]) > 1e6


def test_without_corners_none_are_looked_for():
    config = TrackerConfig(corners=CornerConfig(max_corners=0))
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    contours = tracker.objects.contours(pose()[None].float(), config.contours)
    nothing = tracker.sensors.view(SensorMaps.empty(1, tracker.image_size, torch.device("cpu")), NOW_US[:1])
    assert tracker.sensors.corners(contours, nothing, torch.tensor([5e-3]), config).mask.shape == (1, 0)

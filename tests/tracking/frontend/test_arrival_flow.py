"""Arrival flow: edges of known speed, of either polarity, beside others, at borders, on several sensors; and the cases without one."""

import math

import pytest
import torch
from helpers import generator

from torchtrack.config.tracker import FlowConfig
from torchtrack.tracking.frontend.arrival_flow import MIN_PIXELS, SPAN_US, arrival_flow, plane_flow
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, no_bursts
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import empty_last_event

WIDTH, HEIGHT = 60, 50
MIDDLE = (30, 25)
ARRIVAL = FlowConfig(model="arrival")


def table(streams=1, scale=1.0, dtype=torch.float64):
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return scale * torch.stack([u, v], -1).to(dtype).expand(streams, -1, -1, -1)


def edge_ages(normal, speed_px_s, through=MIDDLE, age_us=1_000):
    """Ages of bursts after a straight edge swept the image; it was at ``through`` so long ago."""
    u, v = table()[0].unbind(-1)
    ages = age_us - 1e6 * ((u - through[0]) * normal[0] + (v - through[1]) * normal[1]) / speed_px_s
    return torch.where((ages >= 0) & (ages < LONG_AGO_US), ages, LONG_AGO_US).round().to(torch.int16)


def bursts(*, off=None, on=None):
    ages = no_bursts(1, HEIGHT, WIDTH)
    for number, plane in enumerate((off, on)):
        if plane is not None:
            ages[0, number] = plane
    return ages


def flow_at(pixels, ages, *, polarity=1.0, mask=True, streams=None, scale=1.0, config=ARRIVAL, dtype=torch.float64):
    """Flow of one or more pixels per object, and where there is one."""
    sensor = torch.tensor(pixels)
    streams = torch.zeros(len(sensor), dtype=torch.int64) if streams is None else torch.tensor(streams)
    polarities = torch.full(sensor.shape[:2], polarity, dtype=dtype)
    points = SensorPoints(sensor, torch.zeros_like(polarities), polarities, torch.full(sensor.shape[:2], mask))
    maps = SensorMaps(empty_last_event(len(ages), HEIGHT, WIDTH), ages)
    return arrival_flow(points, SensorView(maps, torch.zeros(len(ages)).long(), table(len(ages), scale, dtype), streams), config)


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135, 250])
@pytest.mark.parametrize("speed_px_s", [300.0, 2000.0])
def test_an_edge_gives_its_speed_across_itself(angle_deg, speed_px_s, dtype):
    normal = (math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))
    flow, valid = flow_at([[MIDDLE]], bursts(on=edge_ages(normal, speed_px_s)), dtype=dtype)
    assert valid.all() and flow.dtype == dtype
    torch.testing.assert_close(flow[0, 0], speed_px_s * torch.tensor(normal, dtype=dtype), rtol=0, atol=0.01 * speed_px_s)


def test_each_polarity_has_its_own_edge_and_what_has_none_that_which_came_last():
    ages = bursts(off=edge_ages((1.0, 0.0), 400.0, age_us=3_000), on=edge_ages((0.0, -1.0), 800.0, age_us=1_000))
    for polarity, expected in ((-1.0, [400.0, 0.0]), (1.0, [0.0, -800.0]), (0.0, [0.0, -800.0])):
        flow, valid = flow_at([[MIDDLE]], ages, polarity=polarity)
        assert valid.all()
        assert flow[0, 0].tolist() == pytest.approx(expected, abs=5)


def test_pixels_that_another_edge_came_to_hardly_count():
    ages = edge_ages((1.0, 0.0), 400.0)
    ages[24:27, 27] = 100
    flow, valid = flow_at([[MIDDLE]], bursts(on=ages))
    assert valid.all()
    assert flow[0, 0].tolist() == pytest.approx([400.0, 0.0], abs=12)


def test_flow_is_in_ideal_pixels_and_of_the_stream_of_the_object():
    ages = torch.cat([bursts(on=edge_ages((1.0, 0.0), 400.0)), bursts(on=edge_ages((0.0, 1.0), 200.0))])
    flow, _ = flow_at([[MIDDLE], [MIDDLE]], ages, streams=[1, 0], scale=2.0)
    assert flow[0, 0].tolist() == pytest.approx([0.0, 400.0], abs=2)
    assert flow[1, 0].tolist() == pytest.approx([800.0, 0.0], abs=4)


def test_at_the_border_the_pixels_of_the_sensor_count():
    flow, valid = flow_at([[(0, 0), (WIDTH - 1, HEIGHT - 1)]], bursts(on=edge_ages((1.0, 0.0), 4000.0, through=(30, 25), age_us=9_000)))
    assert valid.all()
    assert flow[0].tolist() == [pytest.approx([4000.0, 0.0], rel=0.05)] * 2


@pytest.mark.parametrize("what", ["masked", "never fired", "few pixels", "in a row", "at one time", "long ago"])
def test_there_is_no_flow(what):
    ages, mask = edge_ages((1.0, 0.0), 400.0), what != "masked"
    if what == "never fired":
        ages[:] = LONG_AGO_US
    if what in ("few pixels", "in a row"):
        kept = ages.clone()
        ages[:] = LONG_AGO_US
        if what == "few pixels":
            ages[25:27, 29:31] = kept[25:27, 29:31]
        else:
            ages[25, 27:34] = kept[25, 27:34]
    if what == "at one time":
        ages[:] = 1_000
    if what == "long ago":
        ages[:] = torch.where(torch.arange(WIDTH) == MIDDLE[0], 1_000, 1_001 + SPAN_US).to(torch.int16)
    flow, valid = flow_at([[MIDDLE]], bursts(on=ages), mask=mask)
    assert not valid.any()
    assert flow.tolist() == [[[0, 0]]]


def test_more_pixels_around_give_a_steadier_flow():
    ages = edge_ages((0.6, 0.8), 500.0).double() + 300 * torch.randn(HEIGHT, WIDTH, generator=generator(2), dtype=torch.float64)
    noisy, pixels = bursts(on=ages.clamp(0, LONG_AGO_US).to(torch.int16)), [[(u, 25) for u in range(20, 28)]]
    spread = [float(flow_at(pixels, noisy, config=FlowConfig(radius_px=radius))[0][0].std(0).max()) for radius in (2, 4)]
    assert spread[1] < 0.5 * spread[0]


def test_a_plane_needs_enough_times(dtype):
    offsets = torch.stack(torch.meshgrid(torch.arange(3.0), torch.arange(3.0), indexing="xy"), -1).reshape(9, 2).to(dtype)
    times_s, mask = offsets[:, 0] * 1e-3, torch.zeros(9, dtype=torch.bool)
    mask[:MIN_PIXELS] = True
    flow, valid = plane_flow(offsets, times_s, mask, 3)
    assert valid
    torch.testing.assert_close(flow, torch.tensor([1000.0, 0.0], dtype=dtype), rtol=1e-4, atol=1e-1)
    mask[0] = False
    assert not plane_flow(offsets, times_s, mask, 3)[1]

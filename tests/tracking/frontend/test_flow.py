"""Event flow by reweighted least squares: known velocities, outliers, edges, the cases without flow, and a NumPy twin."""

import math

import numpy as np
import pytest
import torch
from helpers import generator

from torchtrack.config.tracker import FlowConfig
from torchtrack.tracking.frontend.bursts import no_bursts
from torchtrack.tracking.frontend.corners import OLDEST_US
from torchtrack.tracking.frontend.flow import estimate_flow, irls_flow, newest_events_around
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import empty_last_event

NOW_US = 50_000_000
# As wide as these tests were written for.
IRLS = FlowConfig(model="irls", radius_px=5)
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-10}


def trails(velocities, *, count=60, outliers=0, noise_px=0.0, seed=0, dtype=torch.float64):
    """Offsets and times of events along straight trails, the last ``outliers`` of them anywhere."""
    rng = generator(seed)
    velocities = torch.tensor(velocities, dtype=torch.float64)
    times_s = -0.02 * torch.rand((*velocities.shape[:-1], count), generator=rng, dtype=torch.float64)
    offsets = velocities[..., None, :] * times_s[..., None]
    offsets = offsets + noise_px * torch.randn(offsets.shape, generator=rng, dtype=torch.float64)
    wild = (torch.rand(offsets.shape, generator=rng, dtype=torch.float64) - 0.5) * 24
    offsets[..., count - outliers :, :] = wild[..., count - outliers :, :]
    return offsets.to(dtype), times_s.to(dtype), torch.ones(times_s.shape, dtype=torch.bool)


def numpy_irls(offsets, times_s, iterations, tuning):
    """Eq. 8-11 for one corner, written out: alternate flow and bisquare weights, in units of the mean residual."""
    weight = np.ones(len(times_s))
    for _ in range(iterations + 1):
        lever = np.sum(weight * times_s**2)
        flow = np.array([np.sum(weight * times_s * offsets[:, axis]) / lever for axis in range(2)])
        residual = np.hypot(*(offsets - np.outer(times_s, flow)).T)
        bound = tuning * max(np.average(residual, weights=weight), 0.3)
        weight = np.where(residual < bound, (1 - (residual / bound) ** 2) ** 2, 0.0)
    return flow


def events_around(pixels, last_event_us, *, scale=1.0, streams=None, config=None):
    """Offsets, times and mask of the events around the newest events at sensor pixels, one or more per object."""
    sensor = torch.tensor(pixels)
    streams = torch.zeros(len(sensor), dtype=torch.int64) if streams is None else torch.tensor(streams)
    # As of corners: of what never fired, the age is cut off.
    age_us = (NOW_US - last_event_us[streams[:, None], sensor[..., 1], sensor[..., 0]]).clamp(max=OLDEST_US)
    points = SensorPoints(sensor, age_us * 1e-6, torch.zeros(age_us.shape), torch.ones(age_us.shape, dtype=torch.bool))
    return newest_events_around(points, view_of(last_event_us, table(len(last_event_us), scale=scale), streams), config or IRLS)


def view_of(last_event_us, ideal_pixels, streams=None):
    """The sensors of one object, or of one in each of the streams that are given."""
    streams = torch.tensor([0]) if streams is None else streams
    maps = SensorMaps(last_event_us, no_bursts(*last_event_us.shape))
    return SensorView(maps, torch.full((len(last_event_us),), NOW_US), ideal_pixels, streams)


def flow_at(pixels, last_event_us, **kwargs):
    """Flow of one or more pixels per object, and where there is one."""
    return irls_flow(*events_around(pixels, last_event_us, **kwargs), IRLS)


def table(streams=1, width=60, height=50, scale=1.0):
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return scale * torch.stack([u, v], -1).to(torch.float32).expand(streams, -1, -1, -1)


def sweeping_edge(normal, speed_px_s, through=(30, 25), width=60, height=50):
    """Newest event times after a straight edge swept the image; it is at ``through`` now, and nothing is ahead of it."""
    v, u = torch.meshgrid(torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij")
    distance = (u - through[0]) * normal[0] + (v - through[1]) * normal[1]
    t_us = (NOW_US + 1e6 * distance / speed_px_s).round().long()
    return torch.where(distance <= 0, t_us, empty_last_event(1, height, width)[0])[None]


# ---- the least squares


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (120.0, -80.0), (-2000.0, 10.0)])
def test_a_clean_trail_gives_its_velocity(velocity, dtype):
    flow, valid = irls_flow(*trails(velocity, dtype=dtype), IRLS)
    assert valid
    torch.testing.assert_close(flow, torch.tensor(velocity, dtype=dtype), rtol=TOLERANCE[dtype], atol=1e-2 * TOLERANCE[dtype])


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_outliers_do_not_move_the_flow(share, dtype):
    velocity = [300.0, -150.0]
    count = 80
    offsets, times_s, mask = trails(velocity, count=count, outliers=int(share * count), noise_px=0.2, dtype=dtype)
    robust, valid = irls_flow(offsets, times_s, mask, FlowConfig(model="irls", iterations=20))
    plain = torch.linalg.lstsq(times_s[:, None], offsets).solution[0]
    assert valid
    truth = torch.tensor(velocity, dtype=dtype)
    assert float((robust - truth).norm()) < 10
    assert float((robust - truth).norm()) < 0.5 * float((plain - truth).norm())


@pytest.mark.parametrize("iterations", [1, 5, 12])
def test_the_flow_is_that_of_a_plain_loop(iterations, dtype):
    velocities = [[100.0, 40.0], [-500.0, 900.0], [5.0, 0.0]]
    offsets, times_s, mask = trails(velocities, outliers=12, noise_px=0.5, seed=4, dtype=dtype)
    mask[:, 50:53] = False
    flow, valid = irls_flow(offsets, times_s, mask, FlowConfig(model="irls", iterations=iterations))
    assert valid.all()
    for row in range(3):
        keep = mask[row].numpy()
        expected = numpy_irls(offsets[row].double().numpy()[keep], times_s[row].double().numpy()[keep], iterations, 4.685)
        assert flow[row].double().numpy() == pytest.approx(expected, rel=1e-3 if dtype == torch.float32 else 1e-9, abs=1e-3)


def test_every_corner_has_a_flow_of_its_own(dtype):
    velocities = [[[100.0, 40.0], [-500.0, 900.0]], [[5.0, 0.0], [0.0, -70.0]]]
    offsets, times_s, mask = trails(velocities, outliers=10, noise_px=0.3, dtype=dtype)
    together, _ = irls_flow(offsets, times_s, mask, IRLS)
    for i in range(2):
        for j in range(2):
            alone, _ = irls_flow(offsets[i, j], times_s[i, j], mask[i, j], IRLS)
            torch.testing.assert_close(together[i, j], alone, rtol=1e-5, atol=1e-5)


def test_masked_events_do_not_count_whatever_they_are(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], dtype=dtype)
    mask[40:] = False
    offsets[40:] = 1e6
    flow, valid = irls_flow(offsets, times_s, mask, IRLS)
    assert valid
    torch.testing.assert_close(flow, torch.tensor([100.0, 50.0], dtype=dtype), rtol=1e-4, atol=0)


def test_too_few_events_give_no_flow(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], count=8, dtype=dtype)
    assert irls_flow(offsets, times_s, mask, IRLS)[1]
    mask[0] = False
    flow, valid = irls_flow(offsets, times_s, mask, IRLS)
    assert not valid
    assert flow.tolist() == [0, 0]


def test_events_at_one_time_give_no_flow(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], dtype=dtype)
    flow, valid = irls_flow(offsets, torch.zeros_like(times_s), mask, IRLS)
    assert not valid
    assert flow.tolist() == [0, 0]


def test_no_events_and_bad_numbers_give_no_flow_and_harm_no_neighbour(dtype):
    offsets, times_s, mask = trails([[100.0, 50.0], [1.0, 2.0], [100.0, 50.0]], dtype=dtype)
    expected, _ = irls_flow(offsets[0], times_s[0], mask[0], IRLS)
    mask[1] = False
    offsets[2, 3, 0] = torch.nan
    flow, valid = irls_flow(offsets, times_s, mask, IRLS)
    assert valid.tolist() == [True, False, False]
    assert flow[1:].tolist() == [[0, 0], [0, 0]]
    torch.testing.assert_close(flow[0], expected, rtol=1e-6, atol=0)


# ---- from the map of newest events


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135, 250])
def test_an_edge_gives_its_normal_flow(angle_deg):
    normal = (math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))
    speed = 400.0
    flow, valid = flow_at([[(30, 25)]], sweeping_edge(normal, speed))
    assert valid.all()
    assert float(flow[0, 0] @ torch.tensor(normal)) == pytest.approx(speed, rel=0.02)
    assert abs(float(flow[0, 0, 0] * normal[1] - flow[0, 0, 1] * normal[0])) < 0.05 * speed


def test_only_the_trail_behind_the_event_counts():
    """An event newer than the one in the middle, or older than the span, belongs to something else."""
    last = empty_last_event(1, 50, 60)
    last[0, 25, 30] = NOW_US
    last[0, 25, 29], last[0, 25, 28], last[0, 25, 27], last[0, 25, 31] = NOW_US - 1000, NOW_US - 20_000, NOW_US - 20_001, NOW_US + 1
    offsets, times_s, mask = events_around([[(30, 25)]], last, config=FlowConfig(radius_px=3))
    seen = sorted((*offset, time) for offset, time in zip(offsets[mask].tolist(), times_s[mask].tolist(), strict=True))
    assert seen == [pytest.approx(row) for row in ((-2, 0, -0.02), (-1, 0, -0.001), (0, 0, 0))]


def test_an_event_that_is_not_the_newest_of_its_pixel_has_its_own_time():
    last = empty_last_event(1, 50, 60)
    last[0, 25, 30], last[0, 25, 29], last[0, 25, 31] = NOW_US, NOW_US - 9000, NOW_US - 2000
    points = points_at([(30, 25)], [4000], [True], torch.float64)
    _, times_s, mask = newest_events_around(points, view_of(last, table()), FlowConfig(radius_px=3))
    assert times_s[mask].tolist() == pytest.approx([-5e-3])


@pytest.mark.parametrize("radius", [1, 3, 6])
def test_events_are_taken_from_a_disc(radius):
    offsets, _, mask = events_around([[(30, 25)]], torch.full((1, 50, 60), NOW_US), config=FlowConfig(radius_px=radius))
    expected = {(u, v) for u in range(-radius, radius + 1) for v in range(-radius, radius + 1) if u * u + v * v <= radius * radius}
    assert {tuple(offset) for offset in offsets[mask].tolist()} == expected
    assert int(mask.sum()) == len(expected)


def test_events_beyond_the_border_of_the_sensor_do_not_count():
    offsets, _, mask = events_around([[(0, 49)]], torch.full((1, 50, 60), NOW_US), config=FlowConfig(radius_px=2))
    assert {tuple(offset) for offset in offsets[mask].tolist()} == {(0, 0), (1, 0), (2, 0), (0, -1), (1, -1), (0, -2)}


def test_flow_is_in_ideal_pixels():
    flow, _ = flow_at([[(30, 25)]], sweeping_edge((1.0, 0.0), 400.0), scale=2.0)
    assert flow[0, 0].tolist() == pytest.approx([800.0, 0.0], abs=1.0)


def test_flow_is_of_the_stream_of_the_object():
    last = torch.cat([sweeping_edge((1.0, 0.0), 400.0), sweeping_edge((0.0, 1.0), 200.0)])
    flow, _ = flow_at([[(30, 25)], [(30, 25)]], last, streams=[1, 0])
    assert flow[0, 0].tolist() == pytest.approx([0.0, 200.0], abs=1.0)
    assert flow[1, 0].tolist() == pytest.approx([400.0, 0.0], abs=1.0)


def test_pixels_that_never_fired_have_no_flow_and_the_map_is_left_as_it_was():
    last = sweeping_edge((1.0, 0.0), 400.0)
    last[0, :20, :20] = empty_last_event(1, 1, 1)
    before = last.clone()
    flow, valid = flow_at([[(10, 10), (30, 25)]], last)
    assert valid.tolist() == [[False, True]]
    assert flow[0, 0].tolist() == [0, 0]
    assert torch.equal(last, before)


# ---- flow of corners


def points_at(pixels, ages_us, mask, dtype):
    """Points of one object whose newest events are ``ages_us`` old."""
    age_s = torch.tensor([ages_us], dtype=torch.float64).to(dtype) * 1e-6
    return SensorPoints(torch.tensor([pixels]), age_s, torch.zeros_like(age_s), torch.tensor([mask]))


def test_corners_get_their_flow_from_their_own_event_on(dtype):
    """The edge is at 30 px now; what lies 10 px behind fired 25 ms ago, and has the same flow."""
    view = view_of(sweeping_edge((1.0, 0.0), 400.0), table().to(dtype))
    points = points_at([(30, 25), (20, 25), (30, 12)], [0, 25_000, 0], [True, True, False], dtype)
    flow, has_flow = estimate_flow(points, view, IRLS)
    assert has_flow.tolist() == [[True, True, False]]
    assert flow.dtype == dtype
    assert flow[0, :2].tolist() == [pytest.approx([400.0, 0.0], abs=1.0)] * 2
    assert flow[0, 2].tolist() == [0, 0]


def test_the_model_says_which_map_is_looked_at(dtype):
    """No burst is known, so that nothing has arrived anywhere."""
    view = view_of(sweeping_edge((1.0, 0.0), 400.0), table().to(dtype))
    points = points_at([(30, 25)], [0], [True], dtype)
    for config, expected in ((IRLS, True), (FlowConfig(model="arrival"), False)):
        assert estimate_flow(points, view, config)[1].tolist() == [[expected]]

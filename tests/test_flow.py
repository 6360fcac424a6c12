"""Event flow by reweighted least squares: known velocities, outliers, edges, the cases without flow, and a NumPy twin."""

import math

import numpy as np
import pytest
import torch
from helpers import generator

from torchtrack.config.tracker import FlowConfig
from torchtrack.corners import Corners
from torchtrack.flow import estimate_flow, irls_flow, newest_events_around
from torchtrack.time_surface import empty_last_event

NOW_US = 50_000_000
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


def corner_at(pixels, width=60, height=50, scale=1.0, dtype=torch.float64):
    """Corners of one object at given sensor pixels."""
    sensor = torch.tensor([pixels])
    count = sensor.shape[1]
    nothing = torch.zeros(1, count, 2, dtype=dtype)
    mask = torch.ones(1, count, dtype=torch.bool)
    return Corners(sensor, scale * sensor.to(dtype), nothing[..., 0], mask, nothing, ~mask)


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
    flow, valid = irls_flow(*trails(velocity, dtype=dtype), FlowConfig())
    assert valid
    torch.testing.assert_close(flow, torch.tensor(velocity, dtype=dtype), rtol=TOLERANCE[dtype], atol=1e-2 * TOLERANCE[dtype])


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_outliers_do_not_move_the_flow(share, dtype):
    velocity = [300.0, -150.0]
    count = 80
    robust, valid = irls_flow(*trails(velocity, count=count, outliers=int(share * count), noise_px=0.2, dtype=dtype), FlowConfig(iterations=20))
    plain, _ = irls_flow(*trails(velocity, count=count, outliers=int(share * count), noise_px=0.2, dtype=dtype), FlowConfig(tuning=1e6))
    assert valid
    truth = torch.tensor(velocity, dtype=dtype)
    assert float((robust - truth).norm()) < 10
    assert float((robust - truth).norm()) < 0.5 * float((plain - truth).norm())


@pytest.mark.parametrize("iterations", [1, 5, 12])
def test_the_flow_is_that_of_a_plain_loop(iterations, dtype):
    velocities = [[100.0, 40.0], [-500.0, 900.0], [5.0, 0.0]]
    offsets, times_s, mask = trails(velocities, outliers=12, noise_px=0.5, seed=4, dtype=dtype)
    mask[:, 50:53] = False
    config = FlowConfig(iterations=iterations, tuning=3.0)
    flow, valid = irls_flow(offsets, times_s, mask, config)
    assert valid.all()
    for row in range(3):
        keep = mask[row].numpy()
        expected = numpy_irls(offsets[row].double().numpy()[keep], times_s[row].double().numpy()[keep], iterations, 3.0)
        assert flow[row].double().numpy() == pytest.approx(expected, rel=1e-3 if dtype == torch.float32 else 1e-9, abs=1e-3)


def test_every_corner_has_a_flow_of_its_own(dtype):
    velocities = [[[100.0, 40.0], [-500.0, 900.0]], [[5.0, 0.0], [0.0, -70.0]]]
    offsets, times_s, mask = trails(velocities, outliers=10, noise_px=0.3, dtype=dtype)
    together, _ = irls_flow(offsets, times_s, mask, FlowConfig())
    for i in range(2):
        for j in range(2):
            alone, _ = irls_flow(offsets[i, j], times_s[i, j], mask[i, j], FlowConfig())
            torch.testing.assert_close(together[i, j], alone, rtol=1e-5, atol=1e-5)


def test_masked_events_do_not_count_whatever_they_are(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], dtype=dtype)
    mask[40:] = False
    offsets[40:] = 1e6
    flow, valid = irls_flow(offsets, times_s, mask, FlowConfig())
    assert valid
    torch.testing.assert_close(flow, torch.tensor([100.0, 50.0], dtype=dtype), rtol=1e-4, atol=0)


def test_too_few_events_give_no_flow(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], count=8, dtype=dtype)
    assert irls_flow(offsets, times_s, mask, FlowConfig(min_events=8))[1]
    mask[0] = False
    flow, valid = irls_flow(offsets, times_s, mask, FlowConfig(min_events=8))
    assert not valid
    assert flow.tolist() == [0, 0]


def test_events_at_one_time_give_no_flow(dtype):
    offsets, times_s, mask = trails([100.0, 50.0], dtype=dtype)
    flow, valid = irls_flow(offsets, torch.zeros_like(times_s), mask, FlowConfig())
    assert not valid
    assert flow.tolist() == [0, 0]


def test_no_events_and_bad_numbers_give_no_flow_and_harm_no_neighbour(dtype):
    offsets, times_s, mask = trails([[100.0, 50.0], [1.0, 2.0], [100.0, 50.0]], dtype=dtype)
    expected, _ = irls_flow(offsets[0], times_s[0], mask[0], FlowConfig())
    mask[1] = False
    offsets[2, 3, 0] = torch.nan
    flow, valid = irls_flow(offsets, times_s, mask, FlowConfig())
    assert valid.tolist() == [True, False, False]
    assert flow[1:].tolist() == [[0, 0], [0, 0]]
    torch.testing.assert_close(flow[0], expected, rtol=1e-6, atol=0)


# ---- from the map of newest events


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135, 250])
def test_an_edge_gives_its_normal_flow(angle_deg):
    normal = (math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))
    speed = 400.0
    corners = estimate_flow(corner_at([(30, 25)]), sweeping_edge(normal, speed), torch.tensor([0]), table(), FlowConfig())
    assert corners.has_flow.all()
    flow = corners.flow[0, 0]
    assert float(flow @ torch.tensor(normal, dtype=flow.dtype)) == pytest.approx(speed, rel=0.02)
    assert abs(float(flow[0] * normal[1] - flow[1] * normal[0])) < 0.05 * speed


def test_only_the_trail_behind_the_corner_counts():
    """An event newer than the corner's, or older than the span, belongs to something else."""
    last = empty_last_event(1, 50, 60)
    last[0, 25, 30] = NOW_US
    last[0, 25, 29], last[0, 25, 28], last[0, 25, 27], last[0, 25, 31] = NOW_US - 1000, NOW_US - 20_000, NOW_US - 20_001, NOW_US + 1
    offsets, times_s, mask = newest_events_around(corner_at([(30, 25)]), last, torch.tensor([0]), table(), FlowConfig(radius_px=3, span_s=0.02))
    seen = sorted((*offset, time) for offset, time in zip(offsets[mask].tolist(), times_s[mask].tolist(), strict=True))
    assert seen == [pytest.approx(row) for row in ((-2, 0, -0.02), (-1, 0, -0.001), (0, 0, 0))]


@pytest.mark.parametrize("radius", [1, 3, 6])
def test_events_are_taken_from_a_disc(radius):
    last = torch.full((1, 50, 60), NOW_US)
    offsets, _, mask = newest_events_around(corner_at([(30, 25)]), last, torch.tensor([0]), table(), FlowConfig(radius_px=radius))
    expected = {(u, v) for u in range(-radius, radius + 1) for v in range(-radius, radius + 1) if u * u + v * v <= radius * radius}
    assert {tuple(offset) for offset in offsets[mask].tolist()} == expected
    assert int(mask.sum()) == len(expected)


def test_events_beyond_the_border_of_the_sensor_do_not_count():
    last = torch.full((1, 50, 60), NOW_US)
    offsets, _, mask = newest_events_around(corner_at([(0, 49)]), last, torch.tensor([0]), table(), FlowConfig(radius_px=2))
    assert {tuple(offset) for offset in offsets[mask].tolist()} == {(0, 0), (1, 0), (2, 0), (0, -1), (1, -1), (0, -2)}


def test_flow_is_in_ideal_pixels():
    last = sweeping_edge((1.0, 0.0), 400.0)
    corners = estimate_flow(corner_at([(30, 25)], scale=2.0), last, torch.tensor([0]), table(scale=2.0), FlowConfig())
    assert corners.flow[0, 0].tolist() == pytest.approx([800.0, 0.0], abs=1.0)


def test_flow_is_of_the_stream_of_the_object():
    last = torch.cat([sweeping_edge((1.0, 0.0), 400.0), sweeping_edge((0.0, 1.0), 200.0)])
    one = corner_at([(30, 25)])
    both = Corners(*(torch.cat([getattr(one, name)] * 2) for name in vars(one)))
    flow = estimate_flow(both, last, torch.tensor([1, 0]), table(2), FlowConfig()).flow[:, 0]
    assert flow[0].tolist() == pytest.approx([0.0, 200.0], abs=1.0)
    assert flow[1].tolist() == pytest.approx([400.0, 0.0], abs=1.0)


def test_masked_corners_and_corners_without_an_event_have_no_flow():
    corners = corner_at([(30, 25), (10, 10)])
    corners.mask[0, 0] = False
    last = sweeping_edge((1.0, 0.0), 400.0)
    last[0, 10, 10] = empty_last_event(1, 1, 1)[0, 0, 0]
    before = last.clone()
    estimated = estimate_flow(corners, last, torch.tensor([0]), table(), FlowConfig())
    assert not estimated.has_flow.any()
    assert (estimated.flow == 0).all()
    assert torch.equal(last, before)
    assert not corners.has_flow.any()

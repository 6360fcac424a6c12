"""Effects of an event camera, each against what its parameters say."""

import math

import pytest
import torch

from torchtrack.core.events import concatenate
from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.photoreceptor import cutoff_hz, response
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES, EventCameraConfig

SILENT = EVENT_CAMERA_PROFILES["ideal"]


def changed(**changes):
    return SILENT.model_copy(update=changes)


def watch(config, frames, times_us, size=(40, 30), seed=0):
    """All events of even frames of the given luminances, and which of them are noise."""
    camera = EventCamera(config, *size, seed)
    even = [torch.full((size[1], size[0]), float(value)) for value in frames]
    state, batches, causes = camera.start(even[0], times_us[0]), [], []
    for frame, t_us in zip(even[1:], times_us[1:], strict=True):
        state, events, is_noise = camera.step_with_causes(state, frame, t_us)
        batches.append(events)
        causes.append(is_noise)
    return concatenate(batches), torch.cat(causes)


def at_rest(config, luminance, seconds, size=(100, 80)):
    steps = range(round(seconds * 100) + 1)
    return watch(config, [luminance for _ in steps], [10_000 * step for step in steps], size)


@pytest.mark.parametrize(("luminance", "share"), [(0.0, 1.0), (1.0, 0.25)])
def test_shot_noise_has_the_configured_rate(luminance, share):
    events, is_noise = at_rest(changed(shot_noise_rate_hz=2.0), luminance, 1.0)
    assert len(events) / (100 * 80) == pytest.approx(2.0 * share, rel=0.1)
    assert bool(is_noise.all())
    assert float(events.polarity.double().mean()) == pytest.approx(0.5, abs=0.02)


def test_leak_has_the_configured_rate_and_is_told_from_light():
    events, is_noise = at_rest(changed(leak_rate_hz=0.5), 0.4, 4.0)
    assert len(events) / (100 * 80 * 4) == pytest.approx(0.5, rel=0.1)
    assert bool(events.polarity.all())
    assert bool(is_noise.all())
    of_light, is_noise = watch(changed(leak_rate_hz=0.5), [0.1, 0.8], [0, 10_000])
    assert len(of_light) > 1000
    assert not bool(is_noise.any())


def test_hot_pixels_fire_and_no_others():
    events, is_noise = at_rest(changed(hot_pixel_share=0.01, hot_pixel_rate_hz=50.0), 0.3, 3.0)
    pixel = events.y * 100 + events.x
    assert 70 <= len(pixel.unique()) <= 80
    # Rates of 80 pixels are exponentially distributed: their mean scatters by a ninth.
    assert len(events) / (80 * 3) == pytest.approx(50, rel=0.35)
    assert bool(is_noise.all())
    counts = torch.bincount(pixel)
    assert int(counts.max()) > 3 * float(counts[counts > 0].double().mean())


def test_events_are_late_by_the_latency():
    times = [0, 5000, 10_000, 15_000, 20_000]
    early, _ = watch(SILENT, [0.1, 0.3, 0.5, 0.5, 0.5], times)
    late, _ = watch(changed(latency_us=1700), [0.1, 0.3, 0.5, 0.5, 0.5], times)
    assert torch.equal(late.t_us, early.t_us + 1700)
    assert torch.equal(late.x, early.x)


def test_jitter_delays_by_its_mean_and_keeps_order():
    times = list(range(0, 100_001, 1000))
    frames = [0.1 + 0.5 * min(t / 50_000, 1) for t in times]
    early, _ = watch(SILENT, frames, times)
    late, _ = watch(changed(jitter_us=200.0), frames, times)
    assert len(late) == len(early)
    assert bool((torch.diff(late.t_us) >= 0).all())
    delay = (late.t_us.double().mean() - early.t_us.double().mean()).item()
    assert delay == pytest.approx(200, rel=0.1)
    levels = early.t_us.unique()
    spread = torch.stack([(late.t_us - level).double().abs() for level in levels]).amin(0)
    assert float(spread.max()) > 400


def test_what_is_not_read_out_by_the_end_is_not_seen():
    events, _ = watch(changed(latency_us=8000), [0.1, 0.5, 0.5], [0, 5000, 10_000])
    assert 0 < len(events) < len(watch(SILENT, [0.1, 0.5, 0.5], [0, 5000, 10_000])[0])
    assert int(events.t_us.max()) <= 10_000


@pytest.mark.parametrize("duration_us", [100, 1000, 30_000])
def test_photoreceptor_answers_a_ramp_as_the_differential_equation_says(duration_us):
    level, before, after = (torch.tensor([value], dtype=torch.float64) for value in (-1.0, -0.6, 0.4))
    cutoff = torch.tensor([120.0], dtype=torch.float64)
    steps = 20_000
    y, dt = float(level), 1e-6 * duration_us / steps
    for step in range(steps):
        x = -0.6 + (step + 0.5) / steps
        y += dt * 2 * math.pi * 120.0 * (x - y)
    assert float(response(level, before, after, cutoff, 1e-6 * duration_us)) == pytest.approx(y, abs=2e-4)


def test_cutoff_falls_with_the_light_to_a_floor():
    cutoff = cutoff_hz(torch.tensor([0.0, 0.5, 1.0]), 300.0)
    assert cutoff.tolist() == pytest.approx([300 * 20 / 275, 300 * (0.5 + 20 / 255) / (1 + 20 / 255), 300])


@pytest.mark.parametrize("frequency_hz", [20, 300, 1500])
def test_flicker_beyond_the_bandwidth_fades(frequency_hz):
    """Light that flickers by a factor e^±0.6: the swing that is left says how many events a period has."""
    samples, periods = 40, 8
    times = [round(1e6 * i / (samples * frequency_hz) * 100) for i in range(samples * periods)]
    frames = [math.exp(0.6 * math.sin(2 * math.pi * i / samples) - 0.6) for i in range(samples * periods)]
    # Time runs 100 times slower, and so does the photoreceptor: microseconds are too coarse for the fastest flicker.
    slow = changed(bandwidth_hz=3.0, threshold_on=0.02, threshold_off=0.02, dark_level=1e-6)
    swing = {}
    for name, config in (("limited", slow), ("unlimited", slow.model_copy(update={"bandwidth_hz": 0.0}))):
        events, _ = watch(config, frames, times, size=(2, 2))
        settled = events[events.t_us > times[-1] * 2 // 3]
        swing[name] = len(settled)
    # The cutoff falls with the light: at the mean luminance of the flicker it is 0.58 of that at white.
    luminance = math.exp(-0.6)
    at_mean = (luminance + 20 / 255) / (1 + 20 / 255)
    expected = 1 / math.hypot(1, frequency_hz / (300 * at_mean))
    assert swing["limited"] / swing["unlimited"] == pytest.approx(expected, abs=0.12)


def test_bandwidth_delays_an_edge():
    times = list(range(0, 40_001, 200))
    step = [0.5 if t <= 10_000 else 1.0 for t in times]
    sharp, _ = watch(changed(dark_level=1e-6), step, times)
    slow, _ = watch(changed(dark_level=1e-6, bandwidth_hz=100.0), step, times)
    assert len(slow) == len(sharp)
    # ln 2 in thresholds of 0.2: the levels 0.2, 0.4, 0.6 are reached after -ln(1 - level / ln 2) time constants.
    constant_us = 1e6 / (2 * math.pi * 100)
    expected = [10_100 - constant_us * math.log(1 - level / math.log(2)) for level in (0.2, 0.4, 0.6)]
    assert slow.t_us.unique().double().tolist() == pytest.approx(expected, abs=150)


def test_realistic_profile_has_every_effect():
    config = EVENT_CAMERA_PROFILES["realistic"]
    for name in EventCameraConfig.model_fields:
        if name != "latency_us":
            assert getattr(config, name) > 0, name

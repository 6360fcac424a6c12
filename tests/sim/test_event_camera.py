import math

import pytest
import torch

from torchtrack.core.events import concatenate
from torchtrack.errors import EventDataError
from torchtrack.sim.event_camera import NEVER_US, EventCamera
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES, EventCameraConfig

IDEAL = EVENT_CAMERA_PROFILES["ideal"]
# Dark current out of the way: log levels are then those of the luminance.
SHARP = IDEAL.model_copy(update={"dark_level": 1e-9})


def run(camera, frames, times_us):
    """All events of a sequence of frames, and the last state."""
    state, batches = camera.start(frames[0].to(camera.device), times_us[0]), []
    for frame, t_us in zip(frames[1:], times_us[1:], strict=True):
        state, events = camera.step(state, frame.to(camera.device), t_us)
        batches.append(events)
    return concatenate(batches), state


def even(camera, level):
    return torch.full((camera.height, camera.width), float(level))


def step_edge(position, width=40, height=8, left=0.8, right=0.1):
    """An upright edge at ``position``; each pixel gathers the light between -0.5 and +0.5 of its centre."""
    cover = (position - (torch.arange(width) - 0.5)).clamp(0, 1)
    return (left * cover + right * (1 - cover)).expand(height, width)


def edge_events(config, left, right, speed=0.25, seed=0):
    """Events of an edge that crosses the columns 5 to 34 of a small sensor."""
    camera = EventCamera(config, 40, 8, seed)
    positions = torch.arange(4, 35.5, speed).tolist()
    frames = [step_edge(position, left=left, right=right) for position in positions]
    events, _ = run(camera, frames, [1000 * i for i in range(len(frames))])
    return events[(events.x >= 6) & (events.x <= 33)], camera


@pytest.mark.parametrize(("left", "right", "brighter"), [(0.8, 0.1, True), (0.1, 0.8, False)])
def test_moving_edge_fires_the_analytic_count_of_the_right_polarity(left, right, brighter):
    events, camera = edge_events(IDEAL, left, right)
    contrast = abs(math.log((left + IDEAL.dark_level) / (right + IDEAL.dark_level)))
    assert len(events) == 28 * camera.height * math.floor(contrast / 0.2)
    assert bool((events.polarity == brighter).all())


def test_moving_edge_with_mismatch_fires_what_each_threshold_says():
    events, camera = edge_events(IDEAL.model_copy(update={"threshold_mismatch": 0.03}), 0.8, 0.1)
    contrast = math.log((0.8 + IDEAL.dark_level) / (0.1 + IDEAL.dark_level))
    expected = (contrast / camera.threshold_on[:, 6:34]).floor().sum()
    assert len(events) == pytest.approx(float(expected), rel=0.01)
    per_pixel = torch.zeros(8, 40).index_put((events.y.long(), events.x.long()), torch.ones(len(events)), accumulate=True)
    assert len(per_pixel[:, 6:34].unique()) > 3


def test_events_of_an_edge_follow_its_speed():
    events, _ = edge_events(IDEAL, 0.8, 0.1, speed=0.25)
    # 0.25 px per ms; the middle of the trail of each column is when the edge stands at its centre.
    middle_us = torch.stack([events.t_us[events.x == x].double().mean() for x in range(6, 34)])
    assert torch.diff(middle_us) == pytest.approx([4000.0] * 27, abs=20)


def test_sine_grating_fires_the_analytic_count():
    camera, amplitude, frames_per_period, periods = EventCamera(SHARP, 64, 4), 0.75, 100, 3
    x = torch.arange(64.0)
    phase = [2 * math.pi * (x / 16 - i / frames_per_period) for i in range(periods * frames_per_period + 1)]
    frames = [(amplitude * p.sin() - 1).exp().expand(4, 64) for p in phase]
    events, _ = run(camera, frames, [100 * i for i in range(len(frames))])
    # Levels that fire lie a threshold apart, counted from the first; each swing passes all of them.
    start = amplitude * phase[0].sin().double()
    swing = ((amplitude - start) / 0.2).floor() + ((amplitude + start) / 0.2).floor()
    expected = 4 * periods * float(swing.sum())
    assert int(events.polarity.sum()) == pytest.approx(expected, rel=0.05)
    assert int((~events.polarity).sum()) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("frame_us", [300, 1000, 7000])
def test_crossings_of_a_steady_rise_are_timed_to_the_microsecond(frame_us, device):
    camera = EventCamera(SHARP, 2, 1, device=device)
    times = list(range(0, 21_001, frame_us))
    rate = 100e-6  # log units per µs: a threshold of 0.2 every 2000 µs
    events, _ = run(camera, [even(camera, math.exp(rate * t - 2)) for t in times], times)
    expected = [2000 * (1 + i // 2) for i in range(len(events))]
    assert len(events) == 20
    assert events.t_us.tolist() == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("frame_us", [300, 1000, 7000])
@pytest.mark.parametrize("refractory_us", [500, 3000])
def test_the_level_at_the_end_of_the_reset_is_memorised(frame_us, refractory_us):
    camera = EventCamera(SHARP.model_copy(update={"refractory_us": refractory_us}), 1, 1)
    times = list(range(0, 42_001, frame_us))
    events, state = run(camera, [even(camera, math.exp(-100e-6 * t)) for t in times], times)
    # The pixel waits for its release, then for another 2000 µs of steady fall.
    period = 2000 + refractory_us
    expected = list(range(2000, 41_500, period))
    assert events.t_us[events.t_us < 41_500].tolist() == pytest.approx(expected, abs=len(expected))
    assert not bool(events.polarity.any())
    assert int(state.last_event_us[0, 0]) == int(events.t_us[-1])


def test_refractory_period_removes_events():
    free, _ = edge_events(IDEAL, 0.8, 0.1)
    held, _ = edge_events(IDEAL.model_copy(update={"refractory_us": 1000}), 0.8, 0.1)
    assert 0 < len(held) < 0.8 * len(free)
    order = torch.argsort((held.y.long() * 40 + held.x) * 10_000_000 + held.t_us)
    pixel, t_us = (held.y.long() * 40 + held.x)[order], held.t_us[order]
    gaps = torch.diff(t_us)[torch.diff(pixel) == 0]
    assert int(gaps.min()) >= 1000


def static(config, level, seconds=10.0, width=40, height=30, frame_us=50_000, seed=3):
    camera = EventCamera(config, width, height, seed)
    times = list(range(0, round(seconds * 1e6) + 1, frame_us))
    events, _ = run(camera, [even(camera, level)] * len(times), times)
    return events, width * height * seconds


def test_leak_fires_on_events_at_its_rate_from_the_start():
    config = EventCameraConfig(leak_rate_hz=0.5, shot_noise_rate_hz=0)
    events, pixel_seconds = static(config, 0.3)
    assert len(events) == pytest.approx(0.5 * pixel_seconds, rel=0.1)
    assert bool(events.polarity.all())
    # Random phases: as many in the first tenth of a period (2 s) as in any other.
    first = int((events.t_us <= 200_000).sum())
    assert first == pytest.approx(0.5 * 0.2 * 1200, rel=0.35)


@pytest.mark.parametrize(("level", "share"), [(0.0, 1.0), (1.0, 0.25), (0.5, 0.625)])
def test_shot_noise_has_its_rate_and_falls_with_light(level, share):
    config = EventCameraConfig(leak_rate_hz=0, shot_noise_rate_hz=2.0)
    events, pixel_seconds = static(config, level)
    assert len(events) == pytest.approx(2.0 * share * pixel_seconds, rel=0.1)
    assert float(events.polarity.float().mean()) == pytest.approx(0.5, abs=0.03)


def test_noise_resets_the_pixel():
    camera = EventCamera(SHARP.model_copy(update={"shot_noise_rate_hz": 50.0}), 20, 20, seed=1)
    state = camera.start(even(camera, 0.1))
    brighter = even(camera, 0.1 * math.exp(0.15))
    state, noise = camera.step(state, brighter, 20_000)
    fired = state.last_event_us > NEVER_US
    assert 0 < int(fired.sum()) < 400
    # Without noise in between, another 0.1 makes 0.25 since the start, but less since a noise event late enough.
    quiet = EventCamera(SHARP, 20, 20)
    late = state.last_event_us > 15_000
    _, events = quiet.step(state, even(camera, 0.1 * math.exp(0.25)), 30_000)
    hit = torch.zeros(20, 20, dtype=torch.bool).index_put((events.y.long(), events.x.long()), torch.tensor(True))
    assert bool(hit[~fired].all())
    assert not bool(hit[late].any())
    assert len(noise) >= int(fired.sum())


def test_thresholds_have_their_mean_and_spread_and_a_floor():
    camera = EventCamera(EventCameraConfig(threshold_on=0.3), 100, 100)
    assert float(camera.threshold_on.mean()) == pytest.approx(0.3, abs=0.002)
    assert float(camera.threshold_on.std()) == pytest.approx(0.03, rel=0.05)
    assert float(camera.threshold_off.mean()) == pytest.approx(0.2, abs=0.002)
    wild = EventCamera(EventCameraConfig(threshold_mismatch=0.5), 100, 100)
    assert float(wild.threshold_on.min()) > 0


def random_frames(count, seed=0, height=24, width=32):
    generator = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn((count, height, width), generator=generator)
    return list((steps.cumsum(0) - 2).exp())


def test_same_seed_same_events_and_another_seed_others():
    frames, times = random_frames(20), [800 * i for i in range(20)]
    config = EventCameraConfig(shot_noise_rate_hz=50.0)
    first, second, other = (run(EventCamera(config, 32, 24, seed), frames, times)[0] for seed in (5, 5, 6))
    assert len(first) > 500
    for name in ("x", "y", "t_us", "polarity"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert len(first) != len(other) or not torch.equal(first.t_us, other.t_us)


def test_step_is_pure():
    camera = EventCamera(EventCameraConfig(shot_noise_rate_hz=50.0), 32, 24)
    frames = random_frames(3)
    state, _ = camera.step(camera.start(frames[0]), frames[1], 900)
    before = {name: value.clone() for name, value in vars(state).items() if isinstance(value, torch.Tensor)}
    after_a, events_a = camera.step(state, frames[2], 2000)
    after_b, events_b = camera.step(state, frames[2], 2000)
    assert torch.equal(events_a.t_us, events_b.t_us)
    assert torch.equal(after_a.reference, after_b.reference)
    for name, value in before.items():
        assert torch.equal(getattr(state, name), value)


def test_events_are_sorted_and_within_their_interval():
    camera, frames = EventCamera(EventCameraConfig(shot_noise_rate_hz=100.0), 32, 24), random_frames(6)
    state = camera.start(frames[0], 10_000)
    for i, frame in enumerate(frames[1:], start=1):
        state, events = camera.step(state, frame, 10_000 + 1500 * i)
        assert bool((torch.diff(events.t_us) >= 0).all())
        assert int(events.t_us.min()) > 10_000 + 1500 * (i - 1)
        assert int(events.t_us.max()) <= 10_000 + 1500 * i
        assert events.t_us.dtype == torch.int64
        assert events.x.dtype == torch.int32


def test_only_the_changed_region_needs_to_be_looked_at():
    camera = EventCamera(EventCameraConfig(leak_rate_hz=5.0, shot_noise_rate_hz=20.0), 32, 24)
    whole = partial = camera.start(even(camera, 0.3))
    regions = [(slice(2, 9), slice(3, 12)), (slice(12, 20), slice(20, 30))]
    total = 0
    for i in range(1, 30):
        frame = even(camera, 0.3)
        for region in regions:
            frame[region] = 0.3 + 0.2 * math.sin(0.5 * i)
        whole, all_events = camera.step(whole, frame, 2000 * i)
        partial, events = camera.step(partial, frame, 2000 * i, regions)
        assert torch.equal(all_events.t_us, events.t_us)
        assert torch.equal(all_events.x, events.x)
        total += len(events)
    assert total > 1000


def test_leak_goes_on_outside_of_the_regions():
    camera = EventCamera(EventCameraConfig(leak_rate_hz=10.0, shot_noise_rate_hz=0), 32, 24)
    state, batches = camera.start(even(camera, 0.3)), []
    for i in range(1, 101):
        state, events = camera.step(state, even(camera, 0.3), 10_000 * i, [])
        batches.append(events)
    assert len(concatenate(batches)) == pytest.approx(10 * 32 * 24, rel=0.05)


def test_nothing_moves_nothing_fires():
    camera = EventCamera(IDEAL, 16, 12)
    events, _ = run(camera, random_frames(1, height=12, width=16) * 5, [0, 10, 20, 1000, 10**9])
    assert len(events) == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -0.1])
def test_luminance_that_is_no_luminance_is_an_error(value):
    camera = EventCamera(IDEAL, 4, 3)
    state, frame = camera.start(even(camera, 0.5)), even(camera, 0.5)
    frame[1, 2] = value
    with pytest.raises(EventDataError, match="finite and not negative"):
        camera.step(state, frame, 100)
    with pytest.raises(EventDataError, match="finite and not negative"):
        camera.start(frame)


def test_frames_of_another_size_or_out_of_order_are_errors():
    camera = EventCamera(IDEAL, 4, 3)
    state = camera.start(even(camera, 0.5), 100)
    with pytest.raises(EventDataError, match="4x3 pixels, got 3x4"):
        camera.step(state, torch.ones(4, 3), 200)
    with pytest.raises(EventDataError, match="time order: got one at 100"):
        camera.step(state, even(camera, 0.5), 100)

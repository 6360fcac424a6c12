"""Stages: regions, down-scaling, hot pixels and background activity; and the common interface of streams."""

import numpy as np
import pytest
import torch
from helpers import random_events
from hypothesis import given, settings
from hypothesis import strategies as st
from io_files import assert_same, everything, save_npz
from tiny_sequence import write_tiny_sequence

from torchtrack.config.events import EventsConfig
from torchtrack.config.run import RunConfig
from torchtrack.core.camera import Camera, project
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError
from torchtrack.io import open_events
from torchtrack.io.filters import (
    BackgroundFilter,
    Downscaled,
    HotPixelFilter,
    Region,
    downscaled_camera,
    find_hot_pixels,
    region_camera,
)
from torchtrack.run.session import open_session

SIZE = {"width": 64, "height": 48}
CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


@pytest.fixture
def source(tmp_path):
    return open_events(save_npz(tmp_path / "e.npz", random_events(3000, **SIZE)))


def batch_of(rows) -> EventBatch:
    t_us, x, y, p = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventBatch.from_numpy(x, y, t_us, p)


def stream(folder, rows):
    return open_events(save_npz(folder / "rows.npz", batch_of(rows)))


# ---- the common interface


def test_windows_by_time_and_count(source):
    events = everything(source)
    by_time = list(source.windows(duration_us=1000))
    assert all(window.t_end_us - window.t_start_us == 1000 for window in by_time)
    by_count = list(source.windows(count=100))
    assert all(len(window.events) >= 100 for window in by_count[:-1])
    aged = list(source.windows(count=1000, max_age_us=50))
    assert all(window.t_end_us - window.t_start_us <= 50 for window in aged)
    for windows in (by_time, by_count, aged):
        assert_same(concatenate([window.events for window in windows]), events)


@pytest.mark.parametrize("arguments", [{}, {"duration_us": 1, "count": 1}, {"duration_us": 1, "max_age_us": 1}, {"count": 0}, {"duration_us": 0}])
def test_windows_that_make_no_sense(source, arguments):
    with pytest.raises(EventDataError):
        list(source.windows(**arguments))


@pytest.mark.parametrize("t_us", [-1, 0, 1, 5000, 9999, 10_000, 10_001])
def test_seeking_through_stages(source, t_us):
    events = everything(Region(source, 8, 4, 32, 32))
    assert_same(everything(Region(source, 8, 4, 32, 32).seek(t_us)), events[events.t_us >= t_us])
    assert_same(everything(source.seek(t_us)), everything(source)[everything(source).t_us >= t_us])


def test_info_of_part_of_a_stream(source):
    info = source.info(max_events=100)
    assert (info.complete, info.count) == (False, 3000)
    assert info.last_us == int(everything(source).t_us[99])


def test_info_finds_gaps_and_the_busiest_time(tmp_path):
    rows = [(t, 1, 1, 1) for t in [0, 5, 20_005, 20_006, 20_007, 60_000, 70_001]]
    info = stream(tmp_path, rows).info()
    assert [(gap.start_us, gap.duration_us) for gap in info.gaps] == [(5, 20_000), (20_007, 39_993), (60_000, 10_001)]
    assert (info.gap_count, info.peak_rate, info.brighter_share) == (3, 300.0, 1.0)


@pytest.mark.parametrize("times", [[0, 1000, 2000, 4000], [9_000, 9_500, 10_500, 11_000]])
def test_the_peak_of_a_short_recording_is_not_below_its_mean(tmp_path, times):
    info = stream(tmp_path, [(t, 1, 1, 1) for t in times]).info()
    assert info.peak_rate == info.mean_rate == 4 / (1e-6 * (times[-1] - times[0]))


# ---- regions and down-scaling


def test_a_region(source):
    events, region = everything(source), Region(source, 10, 5, 20, 30)
    inside = (events.x >= 10) & (events.x < 30) & (events.y >= 5) & (events.y < 35)
    filtered = everything(region)
    assert (region.width, region.height) == (20, 30)
    assert torch.equal(filtered.x, events.x[inside] - 10)
    assert torch.equal(filtered.y, events.y[inside] - 5)
    assert torch.equal(filtered.t_us, events.t_us[inside])


def test_down_scaling_leaves_out_what_is_over_at_the_border(source):
    scaled, events = Downscaled(source, 5), everything(source)
    assert (scaled.width, scaled.height) == (12, 9)
    filtered = everything(scaled)
    inside = (events.x < 60) & (events.y < 45)
    assert torch.equal(filtered.x, events.x[inside] // 5)
    assert torch.equal(filtered.y, events.y[inside] // 5)


@settings(max_examples=30, deadline=None)
@given(factor=st.integers(1, 7), left=st.integers(0, 20), top=st.integers(0, 20))
def test_the_camera_follows(factor, left, top):
    camera = downscaled_camera(region_camera(CAMERA, left, top, 40, 28), factor)
    points = torch.tensor([[0.1, 0.05, 1.0], [-0.2, 0.1, 0.8]], dtype=torch.float64)
    full, small = (project(points, which.intrinsics(torch.float64)) for which in (CAMERA, camera))
    corner = torch.tensor([left, top], dtype=torch.float64)
    torch.testing.assert_close(small, (full - corner + 0.5) / factor - 0.5)


@pytest.mark.parametrize("region", [(-1, 0, 5, 5), (60, 0, 5, 5), (0, 0, 0, 5), (0, 44, 5, 5)])
def test_regions_that_do_not_fit(source, region):
    with pytest.raises(EventDataError, match="is not within the sensor of 64x48"):
        Region(source, *region)


@pytest.mark.parametrize("factor", [0, 49])
def test_factors_that_make_no_sense(source, factor):
    with pytest.raises(EventDataError, match="between 1 and 48"):
        Downscaled(source, factor)


# ---- hot pixels


def test_hot_pixels_are_found_and_left_out(tmp_path):
    random = np.random.default_rng(0)
    noise = [(int(t), int(x), int(y), 1) for t, x, y in zip(*(random.integers(0, n, 3000) for n in (500_000, 64, 48)), strict=True)]
    hot = [(t, *pixel, 1) for pixel in ((5, 7), (40, 0), (41, 0)) for t in range(0, 500_000, 2000)]
    # An edge: all of a column fires, often.
    edge = [(t, 20, y, 0) for t in range(100_000, 110_000, 200) for y in range(48)]
    source = stream(tmp_path, sorted(noise + hot + edge))
    hot_pixels = find_hot_pixels(source)
    assert [(x, y) for y, x in torch.nonzero(hot_pixels).tolist()] == [(40, 0), (41, 0), (5, 7)]
    kept = everything(HotPixelFilter(source, hot_pixels))
    assert len(kept) == int((~hot_pixels[everything(source).y.long(), everything(source).x.long()]).sum())
    with pytest.raises(EventDataError, match=r"must be \[48, 64\]"):
        HotPixelFilter(source, hot_pixels.T)


def test_a_stream_without_events_has_no_hot_pixels(tmp_path):
    assert not find_hot_pixels(stream(tmp_path, [])).any()


# ---- background activity


def supported(rows, max_age_us: int, min_support: int) -> list[bool]:
    """The definition, event by event."""
    result = []
    for t, x, y, _ in rows:
        near = {(u, v) for s, u, v, _ in rows if 0 <= t - s <= max_age_us and max(abs(u - x), abs(v - y)) == 1}
        result.append(len(near) >= min_support)
    return result


@settings(max_examples=60, deadline=None)
@given(
    rows=st.lists(st.tuples(st.integers(0, 60), st.integers(0, 5), st.integers(0, 4), st.integers(0, 1)), max_size=60).map(sorted),
    age=st.integers(1, 20),
    support=st.integers(1, 3),
    size=st.integers(1, 30),
)
def test_events_stay_where_neighbours_fired(tmp_path_factory, rows, age, support, size):
    source = stream(tmp_path_factory.mktemp("rows"), rows)
    expected = batch_of([row for row, kept in zip(rows, supported(rows, age, support), strict=True) if kept])
    assert_same(concatenate(BackgroundFilter(source, age, support).chunks(size)), expected)


@pytest.mark.parametrize("arguments", [(0, 1), (5, 0), (5, 9)])
def test_support_that_makes_no_sense(source, arguments):
    with pytest.raises(EventDataError, match="max_age_us must be positive and min_support 1 to 8"):
        BackgroundFilter(source, *arguments)


# ---- stages of a run


def test_a_run_prepares_events_and_camera(tmp_path):
    path = write_tiny_sequence(tmp_path)
    plain = open_session(RunConfig(source=path))
    config = EventsConfig(region=(20, 10, 80, 60), downscale=2, hot_pixels=True, background_us=5000)
    session = open_session(RunConfig(source=path, events=config))
    assert (session.camera.width, session.camera.height) == (40, 30)
    assert session.camera == downscaled_camera(region_camera(plain.camera, 20, 10, 80, 60), 2)
    assert 0 < sum(map(len, session.events.chunks())) < sum(map(len, plain.events.chunks()))

"""The map of newest event times, the decayed surface (Eq. 5), and the regions it is computed for."""

import math

import pytest
import torch
from helpers import generator, random_events

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError
from torchtrack.tracking.frontend.time_surface import NEVER_US, Regions, empty_last_event, object_regions, time_surface, update_last_event

TAU_S = 0.01


def events_at(*rows, stream=0):
    """Events of (x, y, t)."""
    x, y, t_us = torch.tensor(rows, dtype=torch.int64).unbind(1)
    return EventBatch(x.int(), y.int(), t_us, torch.zeros(len(t_us), dtype=torch.bool), torch.full((len(t_us),), stream))


def whole(streams, height, width):
    """The whole sensor as the region of one object per stream."""
    origin = torch.zeros(streams, 2, dtype=torch.int64)
    return Regions(origin, torch.tensor([[width, height]] * streams), (height, width), torch.arange(streams))


# ---- newest event times


def test_an_empty_map_has_no_event():
    last = empty_last_event(2, 3, 4)
    assert last.shape == (2, 3, 4)
    assert last.dtype == torch.int64
    assert (last == NEVER_US).all()


def test_the_age_of_a_pixel_that_never_fired_fits_int64():
    assert 0 < 2**53 - NEVER_US < 2**63


@pytest.mark.usefixtures("way")
def test_an_event_is_kept_at_row_y_and_column_x():
    last = update_last_event(empty_last_event(1, 3, 5), events_at((4, 1, 70)))
    assert int(last[0, 1, 4]) == 70
    assert int((last != NEVER_US).sum()) == 1


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("seed", range(3))
def test_the_newest_event_of_a_pixel_is_kept_whatever_the_order(seed):
    events = random_events(2000, width=8, height=6, seed=seed)
    shuffled = events[torch.randperm(len(events), generator=generator(seed))]
    expected = torch.full((1, 6, 8), NEVER_US)
    for x, y, t_us in zip(events.x.tolist(), events.y.tolist(), events.t_us.tolist(), strict=True):
        expected[0, y, x] = max(int(expected[0, y, x]), t_us)
    for order in (events, shuffled, events[torch.arange(len(events)).flip(0)]):
        assert torch.equal(update_last_event(empty_last_event(1, 6, 8), order), expected)


@pytest.mark.usefixtures("way")
def test_older_events_do_not_overwrite_newer_ones_of_earlier_windows():
    last = update_last_event(empty_last_event(1, 2, 2), events_at((0, 0, 100)))
    assert int(update_last_event(last, events_at((0, 0, 40)))[0, 0, 0]) == 100


@pytest.mark.usefixtures("way")
def test_windows_add_up_to_the_whole():
    events = random_events(500)
    halves = update_last_event(update_last_event(empty_last_event(1, 48, 64), events[:200]), events[200:])
    assert torch.equal(halves, update_last_event(empty_last_event(1, 48, 64), events))


@pytest.mark.usefixtures("way")
def test_streams_are_kept_apart():
    both = concatenate([events_at((1, 0, 5)), events_at((1, 0, 9), stream=1)])
    last = update_last_event(empty_last_event(2, 2, 3), both)
    assert last[:, 0, 1].tolist() == [5, 9]


def test_an_event_outside_the_sensor_is_told():
    pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
    with pytest.raises(EventDataError, match=r"event 1 is at \(5, 1\), outside the sensor of 5x3 pixels"):
        update_last_event(empty_last_event(1, 3, 5), events_at((0, 0, 10), (5, 1, 70)))


@pytest.mark.usefixtures("way")
def test_the_input_is_left_as_it_was():
    before = update_last_event(empty_last_event(1, 48, 64), random_events(100, seed=1))
    copy = before.clone()
    update_last_event(before, random_events(100, seed=2))
    assert torch.equal(before, copy)


def test_no_events_change_nothing():
    last = update_last_event(empty_last_event(1, 48, 64), random_events(100))
    assert torch.equal(update_last_event(last, EventBatch.empty()), last)


# ---- the surface


def test_the_surface_has_the_values_of_equation_5(dtype):
    now_us = 10**15
    ages_us = [0, 1, 5_000, 10_000, 30_000]
    last = empty_last_event(1, 1, 6)
    last[0, 0, :5] = now_us - torch.tensor(ages_us)
    surface = time_surface(last, torch.tensor([now_us]), whole(1, 1, 6), TAU_S, dtype)
    expected = torch.tensor([[[*(math.exp(-age * 1e-6 / TAU_S) for age in ages_us), 0.0]]], dtype=dtype)
    assert surface.dtype == dtype
    torch.testing.assert_close(surface, expected, rtol=1e-6, atol=0)


def test_old_events_end_at_zero_and_later_ones_count_as_new(dtype):
    now_us = 1_000_000
    last = torch.tensor([[[now_us - 20_000_000, now_us - 16 * 10_000, now_us - 15 * 10_000, now_us + 500]]])
    surface = time_surface(last, torch.tensor([now_us]), whole(1, 1, 4), TAU_S, dtype)[0, 0]
    assert surface[:2].tolist() == [0, 0]
    assert 0 < float(surface[2]) < 1e-6
    assert float(surface[3]) == 1


def test_a_region_outside_the_sensor_is_zero(dtype):
    last = torch.full((1, 4, 5), 1000)
    regions = Regions(torch.tensor([[-2, -1]]), torch.tensor([[9, 7]]), (7, 9), torch.tensor([0]))
    surface = time_surface(last, torch.tensor([1000]), regions, TAU_S, dtype)
    expected = torch.zeros(1, 7, 9, dtype=dtype)
    expected[0, 1:5, 2:7] = 1
    assert torch.equal(surface, expected)


def test_regions_are_cut_from_their_own_stream_at_its_own_time(dtype):
    last = update_last_event(empty_last_event(2, 20, 30), concatenate([random_events(300, width=30, height=20, seed=s, stream=s) for s in (0, 1)]))
    t_us = torch.tensor([10_000, 20_000])
    full = time_surface(last, t_us, whole(2, 20, 30), TAU_S, dtype)
    regions = Regions(torch.tensor([[3, 2], [10, 8], [0, 5]]), torch.full((3, 2), 6), (6, 6), torch.tensor([1, 0, 1]))
    parts = time_surface(last, t_us, regions, TAU_S, dtype)
    for part, (u, v), stream in zip(parts, regions.origin.tolist(), regions.stream_index.tolist(), strict=True):
        assert torch.equal(part, full[stream, v : v + 6, u : u + 6])


def test_no_window_is_too_long_and_no_decay_too_short(dtype):
    last = torch.tensor([[[0, NEVER_US]]])
    for tau_s in (1e-4, 10.0):
        surface = time_surface(last, torch.tensor([2**53]), whole(1, 1, 2), tau_s, dtype)
        assert surface.tolist() == [[[0, 0]]]


# ---- regions


def test_a_region_holds_the_contours_and_the_margin():
    pixels = torch.tensor([[[40.2, 30.7], [60.5, 50.1], [55.0, 33.0]]])
    regions = object_regions(pixels, torch.ones(1, 3, dtype=torch.bool), torch.tensor([0]), (120, 160), margin_px=12, largest_px=256)
    (u, v), (width, height) = regions.origin[0].tolist(), regions.extent[0].tolist()
    assert 40 - 12 - 3 <= u <= 40 - 12
    assert 30 - 12 - 3 <= v <= 30 - 12
    assert (u + width - 1, v + height - 1) == (61 + 12, 51 + 12)
    assert regions.size[0] >= height
    assert regions.size[1] >= width


def test_masked_and_outside_points_do_not_count():
    pixels = torch.tensor([[[40.0, 30.0], [60.0, 50.0], [-500.0, 7.0], [100.0, 1e6], [100.0, 100.0]]])
    mask = torch.tensor([[True, True, True, True, False]])
    regions = object_regions(pixels, mask, torch.tensor([0]), (120, 160), 12, 256)
    expected = object_regions(pixels[:, :2], mask[:, :2], torch.tensor([0]), (120, 160), 12, 256)
    assert torch.equal(regions.origin, expected.origin)
    assert torch.equal(regions.extent, expected.extent)


def test_an_object_without_contours_gets_the_smallest_region_and_others_keep_theirs():
    pixels = torch.tensor([[[40.0, 30.0], [60.0, 50.0]], [[torch.nan, 1.0], [1e9, 5.0]]])
    regions = object_regions(pixels, torch.ones(2, 2, dtype=torch.bool), torch.tensor([0, 0]), (120, 160), 12, 256)
    alone = object_regions(pixels[:1], torch.ones(1, 2, dtype=torch.bool), torch.tensor([0]), (120, 160), 12, 256)
    assert torch.equal(regions.origin[0], alone.origin[0])
    assert torch.equal(regions.extent[0], alone.extent[0])
    assert (regions.extent[1] <= regions.extent[0]).all()


def test_a_region_does_not_depend_on_the_size_of_the_others():
    small = torch.tensor([[40.0, 30.0], [60.0, 50.0]])
    large = torch.tensor([[10.0, 10.0], [150.0, 110.0]])
    regions = object_regions(torch.stack([small, large]), torch.ones(2, 2, dtype=torch.bool), torch.tensor([0, 0]), (120, 160), 16, 256)
    alone = object_regions(small[None], torch.ones(1, 2, dtype=torch.bool), torch.tensor([0]), (120, 160), 16, 256)
    assert torch.equal(regions.origin[:1], alone.origin)
    assert torch.equal(regions.extent[:1], alone.extent)
    assert regions.size > alone.size

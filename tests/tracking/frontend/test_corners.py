"""Corners of the surface: even selection, snapping to the newest event, freshness, independence of the batch."""

import pytest
import torch
from helpers import generator, random_events

from torchtrack.config.components import Component
from torchtrack.config.tracker import CornerConfig, SurfaceConfig, TrackerConfig
from torchtrack.core import dispatch
from torchtrack.tracking.frontend.bursts import no_bursts
from torchtrack.tracking.frontend.corners import detect_corners, no_corners, select_corners, snap_to_newest
from torchtrack.tracking.frontend.filters import corner_response
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorView
from torchtrack.tracking.frontend.sensors import REGION_MARGIN_PX
from torchtrack.tracking.frontend.time_surface import NEVER_US, Regions, empty_last_event, object_regions, time_surface, update_last_event

SURFACE = SurfaceConfig()
CORNERS = TrackerConfig(corners=CornerConfig(max_corners=32))
NOW_US = 1_000_000


def region(width, height, origin=(0, 0), stream=0):
    return Regions(torch.tensor([origin]), torch.tensor([[width, height]]), (height, width), torch.tensor([stream]))


def squares(*boxes, width=96, height=96, dtype=torch.float32):
    """A surface of zeros with squares (u0, v0, u1, v1, value), the last pixel included."""
    image = torch.zeros(1, height, width, dtype=dtype)
    for u0, v0, u1, v1, value in boxes:
        image[0, v0 : v1 + 1, u0 : u1 + 1] = value
    return image


def pixel_table(streams, height, width, dtype=torch.float32):
    """The undistortion table of a camera without distortion."""
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([u, v], -1).to(dtype).expand(streams, -1, -1, -1)


def detect(last_event_us, regions, *, most=32, without=(), window_s=1.0, surface_config=SURFACE, dtype=torch.float32, t_us=NOW_US):
    streams, height, width = last_event_us.shape
    now = torch.full((streams,), t_us)
    surface = time_surface(last_event_us, now, regions, surface_config.tau_s, dtype)
    window = torch.full((streams,), window_s, dtype=dtype)
    table = pixel_table(streams, height, width, dtype)
    config = TrackerConfig(surface=surface_config, corners=CornerConfig(max_corners=most), disabled=frozenset(without))
    view = SensorView(SensorMaps(last_event_us, no_bursts(streams, height, width)), now, table, regions.stream_index)
    return detect_corners(surface, regions, view, window, config)


def actual(corners, number=0):
    """The corners of one object, as a set of sensor pixels."""
    return {tuple(pixel) for pixel in corners.sensor_pixels[number][corners.mask[number]].tolist()}


def fired(pixels, t_us=NOW_US, width=96, height=96):
    last = empty_last_event(1, height, width)
    for u, v in pixels:
        last[0, v, u] = t_us
    return last


def square_of_events(u0, v0, u1, v1, t_us=NOW_US, width=96, height=96):
    last = empty_last_event(1, height, width)
    last[0, v0 : v1 + 1, u0 : u1 + 1] = t_us
    return last


# ---- selection


@pytest.mark.parametrize("square", [(30, 30, 60, 60), (33, 41, 52, 70)])
def test_the_corners_of_a_square_are_found_and_nothing_else(square):
    u0, v0, u1, v1 = square
    response = corner_response(squares((*square, 1.0)))
    pixels, mask = select_corners(response, region(96, 96), CornerConfig(max_corners=32))
    places = pixels[mask]
    assert len(places) == 4
    for corner in ((u0, v0), (u1, v0), (u0, v1), (u1, v1)):
        assert int((places - torch.tensor(corner)).abs().amax(-1).min()) <= 2


def test_at_most_one_corner_in_a_cell_and_each_the_largest_around():
    response = torch.rand((2, 96, 128), generator=generator(3))
    regions = Regions(torch.zeros(2, 2, dtype=torch.int64), torch.tensor([[128, 96]] * 2), (96, 128), torch.tensor([0, 0]))
    config = CornerConfig(cell_px=8, max_corners=500)
    pixels, mask = select_corners(response, regions, config)
    for number in range(2):
        places = pixels[number][mask[number]]
        assert len(places) > 30
        cells = {tuple(cell) for cell in (places // 8).tolist()}
        assert len(cells) == len(places)
        for u, v in places.tolist():
            patch = response[number, max(v - 2, 10) : min(v + 3, 86), max(u - 2, 10) : min(u + 3, 118)]
            assert float(response[number, v, u]) == float(patch.max())


def test_in_small_cells_there_is_one_corner_each():
    """Not the largest of 5x5 pixels, which would leave most cells without any."""
    response = 1 + torch.rand((1, 96, 96), generator=generator(4))
    pixels, mask = select_corners(response, region(96, 96), CornerConfig(cell_px=3, max_corners=2000))
    assert int(mask.sum()) > 500
    assert len({tuple(cell) for cell in (pixels[mask] // 3).tolist()}) == int(mask.sum())


def test_corners_are_the_strongest_and_at_most_as_many_as_asked_for():
    response = torch.zeros(1, 96, 96)
    places = [(20 + 10 * i, 20 + 10 * j) for i in range(6) for j in range(6)]
    for rank, (u, v) in enumerate(places):
        response[0, v, u] = 1 + rank
    pixels, mask = select_corners(response, region(96, 96), CornerConfig(max_corners=5))
    assert pixels.shape == (1, 5, 2)
    assert mask.all()
    assert {tuple(pixel) for pixel in pixels[0].tolist()} == set(places[-5:])


def test_weak_responses_are_no_corners():
    response = torch.zeros(1, 96, 96)
    response[0, 30, 30], response[0, 60, 60], response[0, 30, 60], response[0, 60, 30] = 1.0, 2e-3, 0.5e-3, -1.0
    pixels, mask = select_corners(response, region(96, 96), CornerConfig(max_corners=32))
    assert {tuple(pixel) for pixel in pixels[mask].tolist()} == {(30, 30), (60, 60)}


def test_a_surface_without_anything_has_no_corners():
    _, mask = select_corners(torch.zeros(1, 64, 64), region(64, 64), CornerConfig(max_corners=32))
    assert not mask.any()


def test_corners_stay_within_the_region_of_their_object():
    response = torch.rand((1, 96, 96), generator=generator(5))
    regions = Regions(torch.zeros(1, 2, dtype=torch.int64), torch.tensor([[50, 70]]), (96, 96), torch.tensor([0]))
    pixels, mask = select_corners(response, regions, CornerConfig(max_corners=500))
    places = pixels[mask]
    assert len(places) > 5
    assert (places >= 0).all()
    assert (places < torch.tensor([50, 70])).all()


def test_what_the_filters_reach_from_beyond_the_region_is_left_out():
    """Twice the half window of the guided filter, which averages twice, and six for what follows: exactly."""
    reach = 2 * 2 + 6
    response = torch.rand((1, 96, 128), generator=generator(6))
    for last in (False, True):
        corner = (127 - reach, 95 - reach) if last else (reach, reach)
        beyond = (corner[0] + 1, corner[1]) if last else (corner[0] - 1, corner[1])
        response[0, beyond[1], beyond[0]], response[0, corner[1], corner[0]] = 3.0, 2.0
    pixels, mask = select_corners(response, region(128, 96), CornerConfig(max_corners=500))
    chosen = {tuple(pixel) for pixel in pixels[mask].tolist()}
    assert {(reach, reach), (127 - reach, 95 - reach)} <= chosen
    assert all(reach <= u <= 127 - reach and reach <= v <= 95 - reach for u, v in chosen)


def test_cells_larger_than_the_region_give_no_corners():
    _, mask = select_corners(torch.rand((1, 32, 32), generator=generator()), region(32, 32), CornerConfig(max_corners=32, cell_px=64))
    assert not mask.any()


# ---- snapping and freshness


def test_snapping_finds_the_newest_event_within_reach():
    last = empty_last_event(1, 20, 30)
    last[0, 10, 12], last[0, 11, 13], last[0, 9, 11], last[0, 10, 14] = 500, 900, 700, 5000
    pixels, newest_us = snap_to_newest(torch.tensor([[[12, 10]]]), last, torch.tensor([0]), 1)
    assert pixels.tolist() == [[[13, 11]]]
    assert newest_us.tolist() == [[900]]
    pixels, newest_us = snap_to_newest(torch.tensor([[[12, 10]]]), last, torch.tensor([0]), 0)
    assert (pixels.tolist(), newest_us.tolist()) == ([[[12, 10]]], [[500]])


def test_snapping_stays_on_the_sensor_and_in_its_stream():
    last = empty_last_event(2, 20, 30)
    last[1, 0, 1] = 40
    pixels, newest_us = snap_to_newest(torch.tensor([[[0, 0], [29, 19]], [[0, 0], [29, 19]]]), last, torch.tensor([0, 1]), 1)
    assert pixels[1, 0].tolist() == [1, 0]
    assert newest_us.tolist() == [[NEVER_US, NEVER_US], [40, NEVER_US]]
    assert (pixels >= 0).all()
    assert (pixels <= torch.tensor([29, 19])).all()


def test_detected_corners_lie_on_the_newest_event_beside_them():
    last = square_of_events(30, 30, 60, 60, t_us=NOW_US - 8_000)
    last[0, 30:61, 30] = NOW_US - 1_000
    corners = detect(last, region(96, 96))
    left = corners.sensor_pixels[0][corners.mask[0] & (corners.sensor_pixels[0, :, 0] < 40)]
    assert len(left) >= 2
    assert (left[:, 0] == 30).all()
    ages = corners.age_s[0][corners.mask[0] & (corners.sensor_pixels[0, :, 0] == 30)]
    torch.testing.assert_close(ages, torch.full_like(ages, 1e-3))


@pytest.mark.parametrize("fresh_only", [True, False])
def test_stale_corners_are_dropped_unless_that_is_disabled(fresh_only):
    last = torch.maximum(square_of_events(20, 20, 40, 40, t_us=NOW_US - 6_000), square_of_events(60, 60, 80, 80, t_us=NOW_US - 2_000))
    corners = detect(last, region(96, 96), without=() if fresh_only else [Component.FRESH_CORNERS], window_s=5e-3)
    ages = corners.age_s[corners.mask]
    assert bool((ages < 5e-3).any())
    assert bool((ages >= 5e-3).any()) != fresh_only


def test_stale_pixels_take_no_place_from_fresh_ones():
    """With room for the corners of one square alone, whose response is less."""
    last = torch.maximum(square_of_events(20, 20, 50, 50, t_us=NOW_US - 6_000), square_of_events(60, 60, 80, 80, t_us=NOW_US - 4_000))
    last[0, 20:51, 20:51] = NOW_US - 5_500
    corners = detect(last, region(96, 96), most=4, window_s=5e-3)
    assert int(corners.mask.sum()) == 4
    assert (corners.sensor_pixels[corners.mask] > 55).all()


def test_corners_have_the_polarity_of_the_edge_that_came_last():
    last, ages = square_of_events(30, 30, 60, 60), no_bursts(1, 96, 96)
    ages[0, 1, :45], ages[0, 0, :45] = 2_000, 4_000
    ages[0, 1, 45:], ages[0, 0, 45:] = 5_000, 1_000
    surface = time_surface(last, torch.tensor([NOW_US]), region(96, 96), SURFACE.tau_s, torch.float32)
    view = SensorView(SensorMaps(last, ages), torch.tensor([NOW_US]), pixel_table(1, 96, 96), torch.tensor([0]))
    corners = detect_corners(surface, region(96, 96), view, torch.ones(1), CORNERS)
    above = corners.sensor_pixels[..., 1] < 45
    assert (corners.polarity[corners.mask & above] == 1).all() and (corners.polarity[corners.mask & ~above] == -1).all()
    assert bool((corners.mask & above).any()) and bool((corners.mask & ~above).any())


def test_an_event_at_the_start_of_the_window_is_of_the_one_before():
    last = square_of_events(30, 30, 60, 60, t_us=NOW_US - 5_000)
    assert not detect(last, region(96, 96), window_s=5e-3).mask.any()
    assert detect(last, region(96, 96), window_s=5.001e-3).mask.any()


def test_without_events_there_are_no_corners():
    assert not detect(empty_last_event(1, 96, 96), region(96, 96)).mask.any()
    assert not detect(empty_last_event(1, 96, 96), region(96, 96), without=[Component.FRESH_CORNERS]).mask.any()


def test_corners_of_nothing():
    corners = no_corners(torch.zeros(3, 7, 2, dtype=torch.float64))
    assert corners.pixels.shape == (3, 0, 2)
    assert corners.pixels.dtype == torch.float64
    assert corners.mask.shape == corners.has_flow.shape == corners.age_s.shape == (3, 0)


def test_ideal_pixels_come_from_the_table_of_the_stream():
    last = square_of_events(30, 30, 60, 60)
    table = pixel_table(1, 96, 96) * 2 + 1
    surface = time_surface(last, torch.tensor([NOW_US]), region(96, 96), SURFACE.tau_s, torch.float32)
    view = SensorView(SensorMaps(last, no_bursts(1, 96, 96)), torch.tensor([NOW_US]), table, torch.tensor([0]))
    corners = detect_corners(surface, region(96, 96), view, torch.ones(1), CORNERS)
    assert corners.mask.any()
    torch.testing.assert_close(corners.pixels, corners.sensor_pixels * 2.0 + 1)


def test_a_region_beyond_the_border_of_the_sensor_finds_the_same_corners():
    last = square_of_events(14, 14, 44, 44)
    inner = detect(last, region(96, 96))
    beyond = detect(last, region(128, 128, origin=(-24, -24)))
    assert len(actual(inner)) >= 4
    assert actual(inner) <= actual(beyond)
    assert (beyond.sensor_pixels >= 0).all()


# ---- independence of the batch


def two_objects(dtype, surface_config=SURFACE):
    """Corners of a small and of a large region, together and each alone."""
    events = random_events(12_000, width=160, height=120, duration_us=NOW_US, seed=2)
    last = update_last_event(empty_last_event(1, 120, 160), events)
    small = torch.tensor([[[40.0, 30.0], [71.0, 59.0]]], dtype=dtype)
    large = torch.tensor([[[20.0, 20.0], [140.0, 100.0]]], dtype=dtype)

    def corners(pixels):
        mask = torch.ones(pixels.shape[:2], dtype=torch.bool)
        regions = object_regions(pixels, mask, torch.zeros(len(pixels), dtype=torch.int64), (120, 160), REGION_MARGIN_PX, 256)
        return detect(last, regions, most=400, without=[Component.CORNER_SNAP], surface_config=surface_config, dtype=dtype)

    together = corners(torch.cat([small, large]))
    return [actual(together, 0), actual(together, 1)], [actual(corners(small)), actual(corners(large))]


@pytest.mark.parametrize("kernels", [False, True])
def test_corners_do_not_depend_on_the_rest_of_the_batch(dtype, kernels):
    with dispatch.backend(wanted=kernels):
        together, alone = two_objects(dtype, SurfaceConfig(tau_s=0.3))
    assert together == alone
    assert min(len(corners) for corners in alone) > 3


def test_more_regions_than_are_filtered_at_a_time():
    events = random_events(4000, width=160, height=120, duration_us=NOW_US, seed=7)
    last = update_last_event(empty_last_event(1, 120, 160), events)
    place = torch.tensor([[30.0, 30.0], [80.0, 60.0]])
    pixels = torch.stack([place + 3 * number for number in range(19)])
    mask = torch.ones(19, 2, dtype=torch.bool)
    many = detect(last, object_regions(pixels, mask, torch.zeros(19, dtype=torch.int64), (120, 160), 16, 256))
    for number in (0, 8, 18):
        single = detect(last, object_regions(pixels[number : number + 1], mask[:1], torch.tensor([0]), (120, 160), 16, 256))
        assert actual(many, number) == actual(single)


# ---- kernels


@pytest.mark.parametrize("cell_px", [3, 8])
@pytest.mark.parametrize("most", [7, 2000])
@pytest.mark.parametrize("without", [(), (Component.FRESH_CORNERS, Component.CORNER_SNAP)])
def test_kernels_choose_the_corners_that_the_reference_does(cell_px, most, without):
    """Of objects of two streams, of which some are partly outside the sensor; more corners than are asked for, or fewer."""
    pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
    last = torch.full((2, 120, 160), NEVER_US)
    for stream in range(2):
        events = random_events(6000, width=160, height=120, duration_us=40_000, seed=stream)
        last[stream] = update_last_event(last[:1], events)[0]
    ages = torch.randint(0, 32_000, (2, 2, 120, 160), generator=generator(7)).to(torch.int16)
    regions = Regions(torch.tensor([[0, 0], [-12, 40], [96, 80]]), torch.tensor([[96, 96], [90, 80], [93, 70]]), (96, 96), torch.tensor([0, 1, 1]))
    config = TrackerConfig(corners=CornerConfig(max_corners=most, cell_px=cell_px), disabled=frozenset(without))
    now, window, table = torch.tensor([40_000, 41_000]), torch.tensor([0.02, 0.03], dtype=torch.float64), pixel_table(2, 120, 160, torch.float64)

    def corners():
        surface = time_surface(last, now, regions, SURFACE.tau_s, torch.float64)
        return detect_corners(surface, regions, SensorView(SensorMaps(last, ages), now, table, regions.stream_index), window, config)

    with torch.inference_mode():
        ours = corners()
        with dispatch.backend(wanted=False):
            theirs = corners()
    for number in range(3):
        rows = []
        for chosen in (ours, theirs):
            values = torch.cat([chosen.sensor_pixels, chosen.pixels, chosen.polarity[..., None], chosen.age_s[..., None]], -1)
            values = values[number][chosen.mask[number]]
            rows.append(torch.tensor(sorted(values.tolist())))
        assert len(rows[0]) > 0
        torch.testing.assert_close(rows[0], rows[1], rtol=0, atol=1e-8)

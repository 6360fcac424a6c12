"""Events that are left out because no object can be near them: none that counts, and most of those that do not."""

from dataclasses import replace

import pytest
import torch
from both_ways import both_ways
from helpers import SMALL_CAMERA, box_model, generator, pose, random_events
from tracked_boxes import WINDOW_US, follow, merged, moving_box, tracker_of, windows

from torchtrack import Tracker
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core.camera import Camera, distort, undistortion_table
from torchtrack.tracking import step
from torchtrack.tracking.expectation import near_tiles, predicted_after
from torchtrack.tracking.frontend.tiles import NearbyEvents, SensorTiles

WIDE = Camera(240.0, 240.0, 320.0, 240.0, 640, 480)
ODD = Camera(240.0, 240.0, 100.0, 70.0, 201, 143, "plumb_bob", (-0.3, 0.1, 0.0, 0.0))


def prediction_at(T_cam_obj):
    tracker = tracker_of()
    return tracker, predicted_after(tracker, tracker.init(T_cam_obj[None], 0), torch.tensor([0.0]))


@pytest.mark.parametrize("camera", [SMALL_CAMERA, ODD])
def test_every_pixel_lies_within_the_reach_of_its_tile(camera):
    ideal = undistortion_table(camera)
    tiles = SensorTiles(ideal[None])
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    tile = tiles.tile_of(u.int(), v.int())
    assert int(tile.max()) == tiles.middle.shape[1] - 1
    away = (ideal - tiles.middle[0, tile]).norm(dim=-1)
    assert (away <= tiles.reach_px[0, tile] + 1e-4).all()
    assert float(tiles.reach_px.max()) < 24


@pytest.mark.parametrize("margin_px", [0.0, 30.0])
@pytest.mark.parametrize("shift_m", [0.0, 0.1, -0.2])
def test_what_can_be_seen_of_an_object_is_near(margin_px, shift_m):
    T_cam_obj = pose(translation=(shift_m, 0.0, 0.5))
    tracker, prediction = prediction_at(T_cam_obj)
    near, by_pytorch = both_ways(lambda: tracker.tiles.near(prediction, torch.tensor([0.005]), margin_px))
    assert torch.equal(near, by_pytorch)
    pixels = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours).pixels[0]
    angle = torch.linspace(0, 6.28, 32)
    around = pixels[:, None] + margin_px * torch.stack([angle.cos(), angle.sin()], -1)
    u, v = torch.from_numpy(distort(around.flatten(0, 1).numpy(), SMALL_CAMERA)).round().int().unbind(-1)
    inside = (u >= 0) & (u < SMALL_CAMERA.width) & (v >= 0) & (v < SMALL_CAMERA.height)
    assert near[0, tracker.tiles.tile_of(u[inside], v[inside])].all()


def test_tiles_far_from_all_objects_are_not_near():
    tracker, prediction = prediction_at(pose(translation=(0.0, 0.0, 2.0)))
    near = tracker.tiles.near(prediction, torch.tensor([0.005]), 8.0)
    assert 0 < int(near.sum()) < near.shape[1] // 2


@pytest.mark.parametrize("turn_rad", [0.0, 0.5])
def test_few_tiles_beside_the_box_around_an_object_are_near(turn_rad):
    T_cam_obj = pose(rotation=(0.0, 0.0, turn_rad), translation=(0.0, 0.0, 0.8))
    tracker, prediction = prediction_at(T_cam_obj)
    prediction.covariance[:] = 0.0
    near, by_pytorch = both_ways(lambda: tracker.tiles.near(prediction, torch.tensor([0.005]), 0.0))
    assert torch.equal(near, by_pytorch)
    pixels = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours).pixels[0]
    # A tile on either side, and what is looked up coarsely.
    sides = pixels.amax(0) - pixels.amin(0) + 2 * (2 * 8 + 4)
    assert int(near.sum()) * 64 <= float(sides.prod())


def test_an_object_that_may_reach_the_camera_is_near_everywhere():
    tracker, prediction = prediction_at(pose(translation=(0.0, 0.0, 0.5)))
    prediction.covariance[:, 5, 5] = 0.15**2
    for near in both_ways(lambda: tracker.tiles.near(prediction, torch.tensor([0.005]), 0.0)):
        assert near.all()


def test_an_object_that_is_not_known_where_to_be_is_near_everywhere():
    tracker, prediction = prediction_at(pose())
    prediction.covariance[:] = torch.nan
    for near in both_ways(lambda: tracker.tiles.near(prediction, torch.tensor([0.005]), 0.0)):
        assert near.all()


def test_kept_events_keep_their_order_and_tell_their_numbers():
    tiles, events = SensorTiles(undistortion_table(SMALL_CAMERA)[None]), random_events(500, width=SMALL_CAMERA.width, height=SMALL_CAMERA.height)
    near = torch.rand((1, tiles.middle.shape[1]), generator=generator(3)) < 0.4
    actual = tiles.keep(events, near)
    kept = actual.events
    assert 0 < len(kept) < 400
    assert torch.equal(kept.t_us, events.t_us[actual.number])
    assert near[0, tiles.tile_of(kept.x, kept.y)].all()
    assert int(near[0, tiles.tile_of(events.x, events.y)].sum()) == len(kept)


def test_where_all_events_are_near_all_are_kept():
    tiles, events = SensorTiles(undistortion_table(SMALL_CAMERA)[None]), random_events(500, width=SMALL_CAMERA.width, height=SMALL_CAMERA.height)
    assert tiles.keep(events, torch.ones(1, tiles.middle.shape[1], dtype=torch.bool)) == NearbyEvents(events)
    none = tiles.keep(events, torch.zeros(2, tiles.middle.shape[1], dtype=torch.bool))
    assert (len(none.events), none.number) == (0, None)


def test_a_step_is_the_same_without_the_events_that_are_left_out(monkeypatch):
    """But for the corners, which see the whole sensor."""
    _, events = moving_box(pose(), 6, camera=WIDE)
    tracker = Tracker([box_model()], WIDE, TrackerConfig(corners=CornerConfig(max_corners=0)))
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 5))
    noise = random_events(20_000, width=WIDE.width, height=WIDE.height, duration_us=WINDOW_US)
    noisy = merged(events, replace(noise, t_us=noise.t_us + 5 * WINDOW_US)).slice_time(5 * WINDOW_US, 6 * WINDOW_US)
    results = [tracker.step(state, noisy)[1]]
    near = near_tiles(tracker, state, torch.tensor([6 * WINDOW_US]))
    assert len(tracker.tiles.keep(noisy, near).events) < len(noisy) // 2
    monkeypatch.setattr(step, "near_objects", lambda tracked, state, expected, events, last: events)
    results.append(tracker.step(state, noisy)[1])
    assert torch.equal(results[0].T_cam_obj, results[1].T_cam_obj)

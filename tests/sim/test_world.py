"""What moves in a scene, and what is behind it."""

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from torchtrack.core.camera import project
from torchtrack.core.lie import se3_inverse, transform_points
from torchtrack.errors import ConfigError
from torchtrack.sim import BackgroundConfig, CameraConfig, MotionConfig, ObjectConfig, SceneConfig
from torchtrack.sim.scenes import LightConfig
from torchtrack.sim.trajectory import CameraMotionConfig
from torchtrack.sim.world import make_world

SMALL = CameraConfig(width=160, height=120, fx=150.0, fy=150.0)
STILL = {"translation_amplitude_m": (0, 0, 0), "rotation_amplitude_deg": (0, 0, 0)}
MOVES = CameraMotionConfig(translation_amplitude_m=(0.1, 0.05, 0.1), rotation_amplitude_deg=(5, 8, 10))


def scene(**changes):
    item = ObjectConfig(label="bracket", shape="lbracket", motion=MotionConfig(position_m=(0, 0, 0.5)))
    return SceneConfig(**{"objects": (item,), "camera": SMALL, "duration_s": 0.5, "seed": 3, **changes})


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(("peak", "px_s"), [("slow", 250), ("normal", 750), (432.0, 432)])
def test_the_fastest_point_has_the_speed_asked_for(peak, px_s):
    world = make_world(scene(peak_speed=peak))
    t_s = torch.linspace(0, 0.5, 5001, dtype=torch.float64)
    assert world.way_px(t_s).max() / 1e-4 == pytest.approx(px_s, rel=0.02)


def test_a_speed_that_cannot_be_reached_is_an_error():
    resting = ObjectConfig(label="bracket", shape="lbracket", motion=MotionConfig(**STILL))
    with pytest.raises(ConfigError, match="peak_speed"):
        make_world(scene(objects=(resting,), peak_speed="slow"))
    with pytest.raises(ValidationError, match="not both"):
        scene(peak_speed="slow", speed=2.0)
    with pytest.raises(ValidationError, match="between 1 and 20000"):
        scene(peak_speed=0.5)


def test_occluders_keep_their_pace():
    bar = ObjectConfig(label="bar", shape="bar", motion=MotionConfig(position_m=(0, 0, 0.3)))
    slow, fast = (make_world(scene(occluders=(bar,), peak_speed=peak)) for peak in ("slow", "fast"))
    t_s = seconds(0.1, 0.3)
    assert torch.equal(slow.object_poses(1, t_s), fast.object_poses(1, t_s))
    assert not torch.allclose(slow.object_poses(0, t_s), fast.object_poses(0, t_s))
    with pytest.raises(ValidationError, match="labels must differ"):
        scene(occluders=(bar.model_copy(update={"label": "bracket"}),))


def test_a_moving_camera_sees_objects_from_where_it_is():
    resting = ObjectConfig(label="bracket", shape="lbracket", motion=MotionConfig(position_m=(0, 0, 0.5), **STILL))
    world = make_world(scene(objects=(resting,), camera_motion=MOVES))
    t_s = seconds(0.0, 0.2, 0.4)
    assert torch.allclose(world.camera_poses(t_s) @ world.object_poses(0, t_s), world.objects[0].pose(t_s), atol=1e-12)
    assert world.way_px(t_s).min() > 1


def test_a_wall_moves_as_its_points_do():
    """A bright spot on the wall is where a point of the world at that place is projected to."""
    config = scene(background=BackgroundConfig(kind="messy", projection="wall", distance_m=1.5, blur_px=0), camera_motion=MOVES)
    world = make_world(config)
    spot = np.zeros_like(world.backdrop.picture)
    spot[130:133, 170:173] = 1.0
    object.__setattr__(world.backdrop, "picture", spot)
    per_m = 150 / 1.5
    point = torch.tensor([[(171 - 159.5) / per_m, (131 - 119.5) / per_m, 1.5]], dtype=torch.float64)
    for t in (0.0, 0.13, 0.31):
        T_world_cam = world.camera_poses(seconds(t))[0]
        seen = world.backdrop.luminance(T_world_cam.numpy(), t)
        row, col = np.mgrid[:120, :160]
        centre = [(seen * col).sum() / seen.sum(), (seen * row).sum() / seen.sum()]
        expected = project(transform_points(se3_inverse(T_world_cam), point), world.camera.intrinsics(torch.float64))[0]
        assert centre == pytest.approx(expected.tolist(), abs=0.15)


def test_a_panorama_turns_with_the_camera_and_does_not_shift_with_it():
    config = BackgroundConfig(kind="messy", projection="panorama")
    turning = MOVES.model_copy(update={"translation_amplitude_m": (0, 0, 0)})
    turned, moved = (make_world(scene(background=config, camera_motion=motion)) for motion in (turning, MOVES))
    T = moved.camera_poses(seconds(0.2))[0].numpy()
    only_turned = T.copy()
    only_turned[:3, 3] = 0
    assert np.array_equal(turned.backdrop.luminance(T, 0.2), moved.backdrop.luminance(only_turned, 0.2))
    half_round = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert np.isfinite(turned.backdrop.luminance(half_round, 0.0)).all()
    assert np.abs(turned.backdrop.luminance(half_round, 0.0) - turned.backdrop.luminance(np.eye(4), 0.0)).mean() > 0.02


def test_a_panning_picture_slides_by_its_speed():
    world = make_world(scene(background=BackgroundConfig(kind="messy", pan_px_s=(40.0, -20.0))))
    first, later = (world.backdrop.luminance(np.eye(4), t) for t in (0.0, 0.5))
    assert np.allclose(later[:100, 30:], first[10:110, 10:140], atol=1e-5)
    assert world.backdrop.way_px(np.eye(4)[None].repeat(2, 0), np.array([0.0, 0.5]))[0] == pytest.approx(np.hypot(20, 10))
    assert world.changes_everywhere


@pytest.mark.parametrize(
    ("background", "camera_moves", "moves"),
    [
        (BackgroundConfig(pan_px_s=(10, 0)), True, False),
        (BackgroundConfig(kind="messy"), True, False),
        (BackgroundConfig(kind="messy", projection="wall"), False, False),
        (BackgroundConfig(kind="messy", projection="wall"), True, True),
        (BackgroundConfig(kind="messy", pan_px_s=(0, 5)), False, True),
    ],
)
def test_only_what_can_be_seen_to_move_counts_as_moving(background, camera_moves, moves):
    assert background.moves(camera_moves) == moves


def test_messy_pictures_are_the_same_for_a_seed_and_full_of_edges():
    first, again, other = (BackgroundConfig(kind="messy", seed=seed).picture(320, 240) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    edges = np.abs(np.diff(np.log(first + 0.005), axis=1)) > 0.2
    assert 0.01 < edges.mean() < 0.3
    faint = np.log(BackgroundConfig(kind="messy", seed=1, contrast=0.3).picture(320, 240))
    assert faint.std() == pytest.approx(0.3 * np.log(first).std(), rel=0.01)
    dimmed = BackgroundConfig(kind="messy", seed=1, brightness=0.5).picture(320, 240)
    assert np.allclose(dimmed, 0.5 * first)


def test_light_flickers_and_goes_round():
    world = make_world(scene(light=LightConfig(flicker_hz=100, flicker_depth=0.2, turn_deg_s=90, turn_axis=(0, 0, 1))))
    eye = np.eye(4)
    assert [world.scenery(eye, t).brightness for t in (0.0, 0.0025, 0.0075)] == pytest.approx([1, 1.2, 0.8])
    start, later = (np.array(world.scenery(eye, t).light_direction) for t in (0.0, 1.0))
    assert later == pytest.approx([-start[1], start[0], start[2]])
    assert world.changes_everywhere


def test_light_stays_where_it_is_when_the_camera_turns():
    world = make_world(scene(camera_motion=MOVES))
    T = world.camera_poses(seconds(0.3))[0].numpy()
    assert T[:3, :3] @ np.array(world.scenery(T, 0.3).light_direction) == pytest.approx(world.config.render.light_direction)


def test_what_is_attached_moves_along():
    item = ObjectConfig(label="bracket", shape="lbracket", motion=MotionConfig(position_m=(0, 0, 0.5)))
    finger = ObjectConfig(label="finger", shape="finger", attached_to="bracket", motion=MotionConfig(position_m=(0.05, 0, 0.01), **STILL))
    world = make_world(scene(objects=(item,), occluders=(finger,), peak_speed="fast", camera_motion=MOVES))
    t_s = seconds(0.0, 0.1, 0.3)
    relative = se3_inverse(world.object_poses(0, t_s)) @ world.object_poses(1, t_s)
    assert torch.allclose(relative, relative[:1].expand(3, 4, 4), atol=1e-12)
    assert relative[0, :3, 3].tolist() == pytest.approx([0.05, 0, 0.01])


@pytest.mark.parametrize("carrier", ["nothing", "finger", "other"])
def test_only_objects_that_are_not_attached_themselves_carry_others(carrier):
    finger, other = (ObjectConfig(label=label, shape="finger", attached_to=to) for label, to in (("finger", carrier), ("other", "bracket")))
    with pytest.raises(ValidationError, match=rf"'finger' cannot be carried by '{carrier}'; name one of .*\(bracket\)"):
        scene(occluders=(finger, other))

import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from torchtrack.core.camera import Camera
from torchtrack.core.lie import rotation_angle_deg, se3_exp, so3_log
from torchtrack.core.pose_checks import check_pose
from torchtrack.io.trajectory import Trajectory, write_tum
from torchtrack.sim.frames import frame_motion, frame_times
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.trajectory import KeyPose, MotionConfig, SinusoidMotion, ground_truth, make_motion, pose_matrix, velocity
from torchtrack.sim.world import longest_way, outer_points

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
CONFIG = MotionConfig(rotation_deg=(20.0, -40.0, 10.0), rotation_amplitude_deg=(30.0, 10.0, 0.0), frequency_hz=1.5)


def way(motions, points):
    """The furthest way of any point, as a function of times."""
    return lambda t_s: np.maximum.reduce(
        [longest_way(motion.pose(t_s), of_object, CAMERA).numpy() for motion, of_object in zip(motions, points, strict=True)]
    )


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_poses_are_rigid_and_swing_about_the_mean():
    T = SinusoidMotion.from_config(CONFIG, seed=3).pose(torch.linspace(0, 100, 5001, dtype=torch.float64))
    check_pose(T, tolerance=1e-9)
    away = (T[:, :3, 3] - torch.tensor(CONFIG.position_m)).abs().amax(0)
    amplitude = torch.tensor(CONFIG.translation_amplitude_m, dtype=torch.float64)
    assert bool((away <= amplitude).all())
    assert bool((away > 0.95 * amplitude).all())
    still = SinusoidMotion.from_config(CONFIG.model_copy(update={"rotation_amplitude_deg": (0.0,) * 3})).pose(seconds(0))
    turned = rotation_angle_deg(T[:, :3, :3], still[:, :3, :3].expand(len(T), 3, 3))
    assert float(turned.max()) <= math.hypot(30, 10)
    assert float(turned.max()) > 28


@pytest.mark.parametrize("speed", [0.0, 0.5, 3.0])
def test_speed_runs_through_the_same_poses_faster(speed):
    t_s = torch.linspace(0, 2, 50, dtype=torch.float64)
    normal, fast = SinusoidMotion.from_config(CONFIG, 1.0, 7), SinusoidMotion.from_config(CONFIG, speed, 7)
    assert torch.allclose(fast.pose(t_s), normal.pose(speed * t_s), atol=1e-12)


def test_seeds_give_different_motions_and_the_same_seed_the_same():
    first, again, other = (SinusoidMotion.from_config(CONFIG, seed=seed).pose(seconds(0.3)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.allclose(first, other, atol=1e-3)


def test_ground_truth_is_sampled_every_millisecond_to_the_end():
    motion = SinusoidMotion.from_config(CONFIG)
    truth = ground_truth(motion, 10_500)
    assert truth.t_us.tolist() == [*range(0, 10_001, 1000), 10_500]
    assert torch.allclose(truth.T_cam_obj[4], motion.pose(seconds(0.004))[0])
    # Between the samples, interpolation is good to a micrometre.
    between = truth.at(torch.tensor([1500, 7300]))
    assert torch.allclose(between, motion.pose(seconds(0.0015, 0.0073)), atol=1e-5)


def test_motion_settings_are_checked():
    with pytest.raises(ValidationError, match="amplitude"):
        MotionConfig(amplitude=3)
    with pytest.raises(ValidationError, match="frequency_hz"):
        MotionConfig(frequency_hz=-1)


@pytest.mark.parametrize("speed", [0.3, 1.0, 4.0])
def test_frames_adapt_to_motion(speed):
    motions = [SinusoidMotion.from_config(CONFIG, speed, seed) for seed in (0, 1)]
    points = [outer_points(make_mesh("lbracket")), outer_points(make_mesh("satellite"))]
    t_us, worst_px = frame_times(way(motions, points), 400_000, 0.5)
    assert t_us[0] == 0
    assert t_us[-1] == 400_000
    assert np.diff(t_us).min() >= 1
    assert np.diff(t_us).max() <= 10_000
    motion_px = frame_motion(way(motions, points), t_us)
    assert motion_px.max() == worst_px <= 0.5
    # Frames are not wasted: they are evenly spread over the motion.
    assert np.median(motion_px) > 0.4


def test_frames_grow_in_number_with_speed():
    counts = []
    for speed in (1.0, 2.0):
        motion = SinusoidMotion.from_config(CONFIG, speed)
        duration_us = round(1e6 / speed)
        counts.append(len(frame_times(way([motion], [outer_points(make_mesh("cube"))]), duration_us, 0.5)[0]))
    # Twice as fast for half as long is the same way.
    assert counts[1] == pytest.approx(counts[0], rel=0.03)


def test_without_motion_there_are_frames_all_the_same():
    motion = SinusoidMotion.from_config(CONFIG, speed=0.0)
    t_us, worst_px = frame_times(way([motion], [outer_points(make_mesh("cube"))]), 100_000, 0.5)
    assert worst_px == 0
    assert 11 <= len(t_us) <= 12


def test_points_behind_the_camera_do_not_ask_for_frames():
    config = CONFIG.model_copy(update={"position_m": (0.0, 0.0, -1.0)})
    t_us, _ = frame_times(way([SinusoidMotion.from_config(config)], [outer_points(make_mesh("cube"))]), 100_000, 0.5)
    assert 11 <= len(t_us) <= 12


def test_motion_is_the_furthest_way_of_a_vertex():
    motion = SinusoidMotion.from_config(MotionConfig(rotation_amplitude_deg=(0, 0, 0), translation_amplitude_m=(0.1, 0, 0)))
    t_us = np.array([0, 1000, 3000])
    x = motion.pose(torch.from_numpy(t_us) * 1e-6)[:, 0, 3]
    points = torch.tensor([[0.0, 0, 0], [0, 0, -0.2], [0, 0, 0.2]], dtype=torch.float64)
    assert frame_motion(way([motion], [points]), t_us) == pytest.approx(600 * torch.diff(x).abs().numpy() / 0.5)


def test_a_spin_turns_at_its_speed_about_its_axis():
    config = MotionConfig(kind="spin", rotation_amplitude_deg=(0, 0, 0), translation_amplitude_m=(0, 0, 0), spin_axis=(0, 0, 2), spin_deg_s=200)
    T = make_motion(config, speed=1.5).pose(seconds(0.0, 0.1))
    turn = T[1, :3, :3] @ T[0, :3, :3].T
    assert torch.rad2deg(so3_log(turn)).tolist() == pytest.approx([0, 0, 30])
    assert torch.equal(T[0, :3, 3], T[1, :3, 3])


def test_a_random_motion_stays_within_its_amplitude_and_differs_from_a_swing():
    config = MotionConfig(kind="random", frequency_hz=2.0)
    t_s = torch.linspace(0, 20, 4001, dtype=torch.float64)
    T = make_motion(config, seed=4).pose(t_s)
    away = (T[:, :3, 3] - torch.tensor(config.position_m)).abs().amax(0)
    assert bool((away <= torch.tensor(config.translation_amplitude_m) + 1e-9).all())
    assert bool((away > 0.5 * torch.tensor(config.translation_amplitude_m)).all())
    # Smooth: no frequency beyond 1.6 times the base.
    acceleration = torch.diff(T[:, 0, 3], n=2) / 0.005**2
    assert float(acceleration.abs().max()) < 0.04 * (2 * math.pi * 2.0 * 1.6) ** 2


KEYS = (
    KeyPose(t_s=0.0, position_m=(0, 0, 0.5)),
    KeyPose(t_s=0.4, position_m=(0.1, 0, 0.5), rotation_deg=(0, 40, 0)),
    KeyPose(t_s=1.0, position_m=(0.1, 0.1, 0.7), rotation_deg=(0, 90, 30)),
)


def test_a_spline_passes_its_keys_smoothly_and_rests_outside():
    motion = make_motion(MotionConfig(kind="keys", keys=KEYS))
    T = motion.pose(seconds(-1.0, 0.0, 0.4, 1.0, 5.0))
    for index, key in ((0, 0), (1, 0), (2, 1), (3, 2), (4, 2)):
        assert torch.allclose(T[index], pose_matrix(KEYS[key].position_m, KEYS[key].rotation_deg), atol=1e-9)
    twist = velocity(motion.pose, torch.linspace(0.01, 0.99, 197, dtype=torch.float64))
    assert float(torch.diff(twist, dim=0).abs().max()) < 0.2
    fast = make_motion(MotionConfig(kind="keys", keys=KEYS), speed=2.0)
    assert torch.allclose(fast.pose(seconds(0.2)), motion.pose(seconds(0.4)))


def test_a_motion_can_come_from_a_file(tmp_path):
    truth = ground_truth(SinusoidMotion.from_config(CONFIG, seed=5), 300_000)
    shifted = Trajectory(truth.t_us + 7_000_000, truth.T_cam_obj)
    write_tum(tmp_path / "motion.tum", shifted)
    motion = make_motion(MotionConfig(kind="file", file=tmp_path / "motion.tum"))
    t_s = seconds(0.0, 0.1234, 0.3)
    assert torch.allclose(motion.pose(t_s), SinusoidMotion.from_config(CONFIG, seed=5).pose(t_s), atol=1e-6)
    write_tum(tmp_path / "one.tum", Trajectory(truth.t_us[:1], truth.T_cam_obj[:1]))
    resting = make_motion(MotionConfig(kind="file", file=tmp_path / "one.tum")).pose(seconds(0.0, 1.0))
    assert torch.allclose(resting, truth.T_cam_obj[:1].expand(2, 4, 4), atol=1e-9)


def test_velocity_carries_poses_on():
    motion = SinusoidMotion.from_config(CONFIG, seed=2)
    t_s = seconds(0.1, 0.7)
    ahead = se3_exp(1e-4 * velocity(motion.pose, t_s)) @ motion.pose(t_s)
    assert torch.allclose(ahead, motion.pose(t_s + 1e-4), atol=1e-6)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "keys"}, "needs keys"),
        ({"keys": KEYS}, "no other kind"),
        ({"kind": "file"}, "a file"),
        ({"kind": "keys", "keys": KEYS[:1]}, "two or more"),
        ({"kind": "keys", "keys": KEYS[::-1]}, "increasing times"),
        ({"kind": "spin", "spin_axis": (0, 0, 0)}, "spin_axis"),
    ],
)
def test_motions_that_make_no_sense_are_errors(values, message):
    with pytest.raises(ValidationError, match=message):
        MotionConfig(**values)

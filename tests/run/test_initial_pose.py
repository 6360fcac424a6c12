"""Initial poses as configured, or by a trajectory that covers the start."""

import json

import pytest
import torch
from kornia.geometry.liegroup import Se3
from pydantic import ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from torchtrack.config.run import ObjectConfig, PoseConfig
from torchtrack.core.lie import se3_exp
from torchtrack.errors import ConfigError, PoseError
from torchtrack.io import Trajectory, write_tum
from torchtrack.run.initial_pose import initial_pose


def moving(start_us: int = 0, count: int = 11, step_us: int = 10_000) -> Trajectory:
    twists = torch.arange(count, dtype=torch.float64)[:, None] * torch.tensor([0.02, 0, 0, 0, 0, 0.01], dtype=torch.float64)
    return Trajectory(start_us + step_us * torch.arange(count), se3_exp(twists))


def configured(**pose) -> ObjectConfig:
    return ObjectConfig(label="mug", mesh="mug.obj", initial_pose=PoseConfig(**pose))


def test_a_quaternion_within_a_percent_of_norm_1():
    T = initial_pose(configured(translation_m=(0, 0, 0.5), quaternion_xyzw=(0, 0, 0.7071, 0.7071)), None, 0)
    assert torch.allclose(T[:3, 0], torch.tensor([0.0, 1, 0], dtype=torch.float64), atol=1e-4)


@pytest.mark.parametrize("quaternion", [(0.1, 0.2, 0.3, 0.4), (0, 0, 90, 0), (0, 0, 0, 0), (float("nan"), 0, 0, 1), (0, 0, 0, 1.05)])
def test_other_quaternions_are_refused(quaternion):
    with pytest.raises(ValidationError, match=r"has norm .*, expected 1.*w is the last.*Euler angles.*degrees"):
        PoseConfig(translation_m=(0, 0, 0.5), quaternion_xyzw=quaternion)


def test_a_matrix_must_be_rigid():
    identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    transposed = [*identity[:3], [0, 0, 0.5, 1]]
    with pytest.raises(PoseError, match="initial_pose of 'mug': the last row must be .*transposed"):
        initial_pose(configured(matrix=transposed), None, 0)
    with pytest.raises(PoseError, match="not a rotation"):
        initial_pose(configured(matrix=[[2, 0, 0, 0], *identity[1:]]), None, 0)


@pytest.mark.parametrize("t_us", [0, 5_000, 100_000, -9_000, 109_000])
def test_a_trajectory_that_covers_the_start(tmp_path, t_us):
    write_tum(tmp_path / "poses.tum", moving())
    T = initial_pose(configured(trajectory=tmp_path / "poses.tum"), None, t_us)
    assert torch.allclose(T, moving().at(torch.tensor([t_us]))[0], atol=1e-9)


@pytest.mark.parametrize("start_us", [1_700_000_000_000_000, 60_000, -200_000])
def test_a_trajectory_that_does_not_is_refused(tmp_path, start_us):
    write_tum(tmp_path / "poses.tum", moving(start_us))
    with pytest.raises(PoseError, match=r"poses.tum' covers .* s to .* s, but the start is at 0.000000 s .start_us.. Is it on another clock"):
        initial_pose(configured(trajectory=tmp_path / "poses.tum"), None, 0)


def test_neither_is_a_gap_in_one(tmp_path):
    before, after = moving(), moving(900_000)
    T = torch.cat([before.T_cam_obj, before.T_cam_obj[-1] @ after.T_cam_obj[5] @ after.T_cam_obj])
    write_tum(tmp_path / "poses.tum", Trajectory(torch.cat([before.t_us, after.t_us]), T))
    with pytest.raises(PoseError, match=r"gap from 0.100000 s to 0.900000 s, and the start at 0.500000 s"):
        initial_pose(configured(trajectory=tmp_path / "poses.tum"), None, 500_000)


def test_ground_truth_is_checked_as_a_trajectory_is():
    obj = ObjectConfig(label="mug")
    assert torch.allclose(initial_pose(obj, moving(), 20_000), moving().T_cam_obj[2])
    with pytest.raises(PoseError, match="the ground truth of 'mug' covers"):
        initial_pose(obj, moving(), 500_000)
    with pytest.raises(ConfigError, match="'mug' needs an initial_pose"):
        initial_pose(obj, None, 0)


def test_settings_of_a_trajectory_need_one():
    with pytest.raises(ValidationError, match="name, time_unit, frame_us and T_cam_world are of a trajectory"):
        PoseConfig(translation_m=(0, 0, 1), time_unit="us")


T_CAM_WORLD = se3_exp(torch.tensor([0.3, -1.0, 0.2, 0.1, 0.2, 1.5], dtype=torch.float64))


def test_a_trajectory_in_a_world_frame(tmp_path):
    write_tum(tmp_path / "poses.tum", moving())
    T = initial_pose(configured(trajectory=tmp_path / "poses.tum", T_cam_world=T_CAM_WORLD.tolist()), None, 25_000)
    torch.testing.assert_close(T, T_CAM_WORLD @ moving().at(torch.tensor([25_000]))[0], atol=1e-9, rtol=0)


def test_a_trajectory_of_bop(tmp_path):
    poses = moving().T_cam_obj
    scene = {
        str(image): [{"obj_id": number, "cam_R_m2c": T[:3, :3].flatten().tolist(), "cam_t_m2c": (1e3 * T[:3, 3]).tolist()} for number, T in
                     ((1, poses[0]), (5, poses[image]))]
        for image in range(11)
    }  # fmt: skip
    (tmp_path / "scene_gt.json").write_text(json.dumps(scene))
    T = initial_pose(configured(trajectory=tmp_path / "scene_gt.json", name="5", frame_us=10_000), None, 40_000)
    torch.testing.assert_close(T, poses[4], atol=1e-9, rtol=0)
    with pytest.raises(PoseError, match="Give frame_us"):
        initial_pose(configured(trajectory=tmp_path / "scene_gt.json", name="5"), None, 40_000)


def test_what_is_of_a_trajectory_needs_one():
    with pytest.raises(ValidationError, match="T_cam_world are of a trajectory; leave them out"):
        PoseConfig(translation_m=(0, 0, 0.5), frame_us=10, T_cam_world=T_CAM_WORLD.tolist())
    with pytest.raises(ValidationError, match="T_cam_world: the upper left 3x3 block is not a rotation"):
        PoseConfig(trajectory="/poses.tum", T_cam_world=(2 * T_CAM_WORLD).tolist())


@pytest.mark.parametrize("given", [T_CAM_WORLD, T_CAM_WORLD.numpy(), RigidTransform.from_matrix(T_CAM_WORLD.numpy()), Se3.from_matrix(T_CAM_WORLD)])
def test_poses_of_other_libraries(given):
    torch.testing.assert_close(initial_pose(configured(matrix=given), None, 0), T_CAM_WORLD)


def test_what_is_no_pose_is_an_error_of_the_setting():
    with pytest.raises(ValidationError, match="a rotation alone is no pose"):
        PoseConfig(matrix=Rotation.identity())

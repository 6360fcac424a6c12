"""Messages of poses: made of rosbags' types, as those of rclpy take the same fields; the covariance is that of ROS."""

import numpy as np
import pytest
import torch
from stand_in_ros import STORE

from torchtrack.core.lie import quaternion_from_rotation, se3_exp, so3_log
from torchtrack.io.ros_clock import PacketClock
from torchtrack.io.ros_poses import NAMES, POSE, TRANSFORMS, ObjectPose, PoseMessages, pose_topic, position_rotation_covariance

T_CAM_OBJ = se3_exp(torch.tensor([0.4, -0.3, 1.2, 0.2, -0.1, 0.9], dtype=torch.float64))
MESSAGES = PoseMessages({name: STORE.types[kind] for name, kind in NAMES.items()}, "event_camera")


def covariance() -> torch.Tensor:
    root = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 6))) * 1e-3
    return root @ root.mT


def test_covariance_is_that_of_position_and_rotation_about_fixed_axes():
    """Against many poses drawn with the covariance of the perturbation."""
    drawn = torch.from_numpy(np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance().numpy(), 200_000))
    T = se3_exp(drawn) @ T_CAM_OBJ
    moved = T[:, :3, 3] - T_CAM_OBJ[:3, 3]
    turned = so3_log(T[:, :3, :3] @ T_CAM_OBJ[:3, :3].mT)
    measured = torch.cat([moved, turned], 1).T.cov()
    expected = position_rotation_covariance(covariance(), T_CAM_OBJ)
    assert float((measured - expected).abs().max()) < 0.02 * float(expected.abs().max())
    # It is not the same numbers in another order: the object is far from what it turns about.
    exchanged = covariance().roll((3, 3), (0, 1))
    assert float((exchanged - expected).abs().max()) > 0.2 * float(expected.abs().max())


def test_messages_of_poses_round_trip():
    pose = ObjectPose("mug", T_CAM_OBJ, quaternion_from_rotation(T_CAM_OBJ[:3, :3]), covariance())
    stamp_ns = 1_700_000_123_456_789_000
    again = STORE.deserialize_cdr(STORE.serialize_cdr(MESSAGES.pose(pose, stamp_ns), POSE), POSE)
    assert (again.header.frame_id, again.header.stamp.sec, again.header.stamp.nanosec) == ("event_camera", 1_700_000_123, 456_789_000)
    assert [again.pose.pose.position.x, again.pose.pose.position.y, again.pose.pose.position.z] == T_CAM_OBJ[:3, 3].tolist()
    np.testing.assert_array_equal(again.pose.covariance.reshape(6, 6), position_rotation_covariance(covariance(), T_CAM_OBJ))
    transforms = STORE.deserialize_cdr(STORE.serialize_cdr(MESSAGES.transforms([pose, pose], stamp_ns), TRANSFORMS), TRANSFORMS).transforms
    assert [transform.child_frame_id for transform in transforms] == ["mug", "mug"]
    rotation = transforms[0].transform.rotation
    assert [rotation.x, rotation.y, rotation.z, rotation.w] == pose.quaternion_xyzw.tolist()
    assert transforms[1].transform.translation.z == float(T_CAM_OBJ[2, 3])


def test_topics_have_names_that_ros_takes():
    assert pose_topic("my-mug.v2") == "/torchtrack/my_mug_v2/pose"


def test_the_clock_of_a_camera_is_that_of_the_packets_that_came_soonest():
    clock = PacketClock()
    assert clock.ros_time_us(5) == 5
    for number, late_us in enumerate([900, 40, 300, 0, 700]):
        clock.add(1_000_000 + 10_000 * number + late_us, 10_000 * number)
    assert clock.ros_time_us(25_000) == 1_025_000


@pytest.mark.parametrize("jump_us", [-60_000_000, 60_000_000])
def test_a_camera_that_starts_anew_has_another_clock(jump_us):
    clock = PacketClock()
    clock.add(1_000_000, 0)
    clock.add(1_000_000 + jump_us, 50)
    assert clock.ros_time_us(50) == 1_000_000 + jump_us


def test_a_clock_that_drifts_is_followed():
    clock = PacketClock()
    for number in range(2000):
        clock.add(1000 * number + number // 10, 1000 * number)
    assert clock.ros_time_us(0) == 150

"""Poses as messages of ROS 2: ``PoseWithCovarianceStamped`` and TF. The same code makes those of rclpy and those of rosbags.

A pose is that of the object in the camera's optical frame (x right, y down, z forward, as REP 103 has it); it is the transform from the
frame of the object, which is called as its label, to that of the camera.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from torchtrack.core.pose_covariance import origin_covariance

POSE, TRANSFORMS = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
TF_TOPIC = "/tf"
# All kinds of messages that are made, by their names in MessageTypes.
NAMES = {
    "Time": "builtin_interfaces/msg/Time",
    "Header": "std_msgs/msg/Header",
    "Point": "geometry_msgs/msg/Point",
    "Vector3": "geometry_msgs/msg/Vector3",
    "Quaternion": "geometry_msgs/msg/Quaternion",
    "Pose": "geometry_msgs/msg/Pose",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovariance",
    "PoseWithCovarianceStamped": POSE,
    "Transform": "geometry_msgs/msg/Transform",
    "TransformStamped": "geometry_msgs/msg/TransformStamped",
    "TFMessage": TRANSFORMS,
}


def pose_topic(label: str) -> str:
    """Where the poses of an object go; a name of ROS has no dots or dashes."""
    return f"/torchtrack/{label.replace('.', '_').replace('-', '_')}/pose"


def position_rotation_covariance(covariance: Float[Tensor, "6 6"], T_cam_obj: Float[Tensor, "4 4"]) -> Float[Tensor, "6 6"]:
    """Covariance of position and of rotation about the fixed axes of the camera, in this order, as ROS has it.

    Ours is of ``[φ, ρ]`` in ``exp(ξ) T``, a rotation about the camera's own origin; see :func:`origin_covariance`.
    """
    rotation_first = origin_covariance(covariance.double()[None], T_cam_obj.double()[None])[0]
    return rotation_first.roll((3, 3), (0, 1))


@dataclass(frozen=True)
class ObjectPose:
    """The pose of one object at one time.

    Args:
        label: of the object.
        T_cam_obj: its pose (m).
        quaternion_xyzw: its rotation, with the sign to be written.
        covariance: as in :class:`torchtrack.tracking.state.StepResult`.
    """

    label: str
    T_cam_obj: Float[Tensor, "4 4"]
    quaternion_xyzw: Float[Tensor, "4"]
    covariance: Float[Tensor, "6 6"]


@dataclass(frozen=True)
class PoseMessages:
    """Makes messages of the types of a library.

    Args:
        types: the type of each of :data:`NAMES`, which takes its fields by name.
        frame: name of the camera's frame.
    """

    types: dict[str, Any]
    frame: str

    def pose(self, pose: ObjectPose, stamp_ns: int) -> Any:
        """A ``PoseWithCovarianceStamped``."""
        x, y, z = pose.T_cam_obj[:3, 3].tolist()
        rows = position_rotation_covariance(pose.covariance, pose.T_cam_obj)
        at = self.types["Pose"](position=self.types["Point"](x=x, y=y, z=z), orientation=self._quaternion(pose))
        with_covariance = self.types["PoseWithCovariance"](pose=at, covariance=rows.flatten().cpu().numpy())
        return self.types["PoseWithCovarianceStamped"](header=self._header(stamp_ns), pose=with_covariance)

    def transforms(self, poses: Iterable[ObjectPose], stamp_ns: int) -> Any:
        """A ``TFMessage`` of all objects, each a child of the camera's frame."""
        return self.types["TFMessage"](transforms=[self._transform(pose, stamp_ns) for pose in poses])

    def _transform(self, pose: ObjectPose, stamp_ns: int) -> Any:
        x, y, z = pose.T_cam_obj[:3, 3].tolist()
        transform = self.types["Transform"](translation=self.types["Vector3"](x=x, y=y, z=z), rotation=self._quaternion(pose))
        return self.types["TransformStamped"](header=self._header(stamp_ns), child_frame_id=pose.label, transform=transform)

    def _quaternion(self, pose: ObjectPose) -> Any:
        x, y, z, w = pose.quaternion_xyzw.tolist()
        return self.types["Quaternion"](x=x, y=y, z=z, w=w)

    def _header(self, stamp_ns: int) -> Any:
        return self.types["Header"](stamp=self.types["Time"](sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000), frame_id=self.frame)

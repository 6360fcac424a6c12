"""Poses on topics of ROS 2, of a run whose events are from one."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from torchtrack.io.ros_poses import TF_TOPIC, PoseMessages, pose_topic
from torchtrack.run.sinks.ros_bag import PosesOfSteps
from torchtrack.run.stepping import Step


@runtime_checkable
class RosTopics(Protocol):
    """Where messages are published, as :class:`torchtrack.io.ros_live.RosSource` does."""

    frame: str

    @property
    def message_types(self) -> dict[str, Any]:
        """The types of :data:`torchtrack.io.ros_poses.NAMES`."""
        ...

    def ros_time_ns(self, t_us: int) -> int:
        """A time of the stream by the clock of ROS."""
        ...

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message."""
        ...

    def close(self) -> None:
        """Take the node away."""
        ...


class RosPublisher:
    """Publishes each pose as it is tracked, on ``/torchtrack/LABEL/pose`` and ``/tf``, in the frame that the camera's packets name.

    Args:
        topics: where to.
        labels: of the objects.
    """

    def __init__(self, topics: RosTopics, labels: Sequence[str]) -> None:
        self._topics, self._types, self._poses = topics, topics.message_types, PosesOfSteps(labels)

    def add(self, step: Step) -> None:
        """Publish the poses of one step."""
        messages = PoseMessages(self._types, self._topics.frame)
        stamp_ns = self._topics.ros_time_ns(int(step.result.t_us[0]))
        poses = self._poses.known(step.result)
        for pose in poses:
            self._topics.publish(pose_topic(pose.label), messages.pose(pose, stamp_ns))
        if poses:
            self._topics.publish(TF_TOPIC, messages.transforms(poses, stamp_ns))

    def close(self) -> None:
        """Take the node away."""
        self._topics.close()

"""Poses in a bag of ROS 2 (``poses.mcap``): what a node would publish, at the times of the stream."""

import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch

from torchtrack.core.atomic import temporary_folder, writing
from torchtrack.core.lie import quaternion_from_rotation, with_signs_of
from torchtrack.errors import OutputError
from torchtrack.io.extras import optional
from torchtrack.io.ros_poses import NAMES, POSE, TF_TOPIC, TRANSFORMS, ObjectPose, PoseMessages, pose_topic
from torchtrack.run.stepping import Step
from torchtrack.tracking.state import StepResult
from torchtrack.tracking.validation.status import Status

FRAME = "camera"
# Of these, the pose is a mere guess: who listens to TF is to see that none comes.
UNKNOWN = (Status.LOST, Status.OUT_OF_VIEW, Status.DIVERGED)


class PosesOfSteps:
    """From results to the poses that are published: those that are known, with quaternions that keep their sign.

    Args:
        labels: of the objects.
    """

    def __init__(self, labels: Sequence[str]) -> None:
        self._labels = labels
        self._quaternions = torch.zeros(len(labels), 4, dtype=torch.float64)

    def known(self, result: StepResult) -> list[ObjectPose]:
        """The poses of the objects that are neither lost nor out of view."""
        T, covariance = result.T_cam_obj.cpu(), result.covariance.cpu()
        self._quaternions = with_signs_of(quaternion_from_rotation(T[:, :3, :3]), self._quaternions)
        columns = zip(self._labels, T, self._quaternions, covariance, result.status.tolist(), strict=True)
        return [ObjectPose(*pose) for *pose, status in columns if status not in UNKNOWN]


class PoseBag:
    """Writes ``PoseWithCovarianceStamped`` on ``/torchtrack/LABEL/pose`` and the transforms on ``/tf``; the file appears when it is closed.

    Args:
        path: of the file, ``.mcap``.
        labels: of the objects.

    Raises:
        MissingExtraError: if the library that writes bags is not installed.
        OutputError: if the file cannot be written.
    """

    def __init__(self, path: Path, labels: Sequence[str]) -> None:
        rosbag2 = optional("rosbags.rosbag2", "rosbags", "ros", f"writing '{path.name}'")
        typesys = optional("rosbags.typesys", "rosbags", "ros", f"writing '{path.name}'")
        self._path, self._poses = path, PosesOfSteps(labels)
        self._store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self._messages = PoseMessages({name: self._store.types[kind] for name, kind in NAMES.items()}, FRAME)
        self._failures = (rosbag2.WriterError, struct.error, sqlite3.Error, OSError)
        with ExitStack() as opening:
            folder = opening.enter_context(temporary_folder(path)) / "bag"
            with self._writing():
                self._writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
                self._writer.open()
                self._topics = {label: self._connection(pose_topic(label), POSE) for label in labels}
                self._transforms = self._connection(TF_TOPIC, TRANSFORMS)
            self._written, self._open = folder / "bag.mcap", opening.pop_all()

    def _connection(self, topic: str, kind: str) -> Any:
        return self._writer.add_connection(topic, kind, typestore=self._store)

    def add(self, step: Step) -> None:
        """Write the poses of one step."""
        stamp_ns = 1000 * int(step.result.t_us[0])
        poses = self._poses.known(step.result)
        with self._writing():
            for pose in poses:
                self._write(self._topics[pose.label], self._messages.pose(pose, stamp_ns), stamp_ns, POSE)
            if poses:
                self._write(self._transforms, self._messages.transforms(poses, stamp_ns), stamp_ns, TRANSFORMS)

    def _write(self, connection: Any, message: Any, stamp_ns: int, kind: str) -> None:
        self._writer.write(connection, stamp_ns, self._store.serialize_cdr(message, kind))

    def close(self) -> None:
        """Complete the file, and put it in its place."""
        with self._open, self._writing():
            self._writer.close()
            self._written.replace(self._path)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """What the library or the system refuses becomes an :class:`OutputError`."""
        try:
            with writing(self._path):
                yield
        except OutputError:
            raise
        except self._failures as error:
            raise OutputError(f"cannot write to '{self._path}': {error}.") from error

"""``poses.mcap``: the poses of a run as messages of ROS 2, read again by rosbags."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from kept_steps import KeptSteps
from rosbags.rosbag2 import Reader
from stand_in_ros import STORE
from tiny_sequence import write_tiny_sequence

from torchtrack.config.run import RunConfig
from torchtrack.errors import MissingExtraError, OutputError
from torchtrack.io import extras, read_tum
from torchtrack.run.runner import run
from torchtrack.run.sinks.ros_bag import PoseBag, PosesOfSteps
from torchtrack.tracking.validation.status import Status


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Folder and steps of a run."""
    folder = tmp_path_factory.mktemp("run")
    steps = KeptSteps()
    path = write_tiny_sequence(folder, labels=("left", "right.2"), duration_us=20_000)
    run(RunConfig(source=path, output=folder / "out", overlay={"enabled": False}, ros={"bag": True}), [steps])
    return folder / "out", steps.steps


def messages_of(path):
    with Reader(path) as reader:
        return [(c.topic, stamp, STORE.deserialize_cdr(data, c.msgtype)) for c, stamp, data in reader.messages()]


def test_a_run_writes_poses_and_transforms(tracked):
    folder, steps = tracked
    messages = messages_of(folder / "poses.mcap")
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        ["config.yaml", "first_window.png", "poses.csv", "poses.mcap", "summary.json", "trajectory_left.tum", "trajectory_right.2.tum"]
    )
    trajectory = read_tum(folder / "trajectory_right.2.tum")
    poses = [(stamp, message) for topic, stamp, message in messages if topic == "/torchtrack/right_2/pose"]
    assert [stamp for stamp, _ in poses] == [1000 * t_us for t_us in trajectory.t_us.tolist()]
    at = poses[1][1].pose.pose
    rows = np.loadtxt(folder / "trajectory_right.2.tum")
    np.testing.assert_allclose([at.position.x, at.position.y, at.position.z], rows[1, 1:4], rtol=1e-9)
    np.testing.assert_allclose([at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w], rows[1, 4:], rtol=1e-9)
    transforms = [message.transforms for topic, _, message in messages if topic == "/tf"]
    assert len(transforms) == len(steps)
    assert [[transform.child_frame_id for transform in of_step] for of_step in transforms] == [["left", "right.2"]] * len(steps)
    assert {transform.header.frame_id for of_step in transforms for transform in of_step} == {"camera"}


def test_lost_objects_have_no_pose(tracked):
    result = tracked[1][0].result
    of_labels = PosesOfSteps(["left", "right"])
    assert [pose.label for pose in of_labels.known(result)] == ["left", "right"]
    for status in (Status.LOST, Status.OUT_OF_VIEW, Status.DIVERGED):
        lost = replace(result, status=torch.tensor([int(status), int(Status.UNCERTAIN)]))
        assert [pose.label for pose in of_labels.known(lost)] == ["right"]


def test_a_bag_of_nothing_and_one_that_is_not_closed(tracked, tmp_path):
    PoseBag(tmp_path / "poses.mcap", ["left"]).close()
    assert messages_of(tmp_path / "poses.mcap") == []
    bag = PoseBag(tmp_path / "other.mcap", ["left", "right"])
    bag.add(tracked[1][0])
    assert not (tmp_path / "other.mcap").exists()
    bag.close()
    assert len(messages_of(tmp_path / "other.mcap")) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.mcap", "poses.mcap"]


def test_it_replaces_no_folder(tmp_path):
    with pytest.raises(OutputError, match="it is a folder"):
        PoseBag(tmp_path, ["left"])


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    def missing(module, *rest):
        raise ImportError(module)

    monkeypatch.setattr(extras.importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"writing 'poses.mcap' needs the library 'rosbags'.*torchtrack\[ros\]"):
        PoseBag(tmp_path / "poses.mcap", ["left"])


def test_an_earlier_bag_is_set_aside_as_all_files_are(tracked):
    folder, _ = tracked
    source = json.loads((folder / "summary.json").read_text())["source"]
    run(RunConfig(source=folder.parent / f"{source}.npz", output=folder, overlay={"enabled": False}))
    assert not (folder / "poses.mcap").exists() and (folder / "poses.csv").exists()

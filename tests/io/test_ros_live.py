"""Packets of a topic of ROS 2 are tracked, and poses are published: with a stand-in for rclpy, and messages that rosbags makes."""

import threading
import time

import numpy as np
import pytest
import torch
from helpers import random_events
from io_files import assert_same
from stand_in_ros import StandInRos, mono_packets, packet
from tiny_sequence import CAMERA, write_tiny_sequence

from torchtrack.config.events import is_live
from torchtrack.config.run import RunConfig
from torchtrack.core.events import concatenate
from torchtrack.errors import ConfigError, EventDataError
from torchtrack.io import open_live, read_sequence, read_tum
from torchtrack.io.writers.evt3 import Evt3Writer
from torchtrack.run.runner import run

SIZE = (64, 48)
COUNT = 3000
# The clock of ROS is so far ahead of the camera's.
AHEAD_US = 1_700_000_000_000_000


@pytest.fixture
def ros(monkeypatch):
    stand_in = StandInRos()
    stand_in.install(monkeypatch)
    return stand_in


def test_addresses():
    assert is_live("ros:///event_camera/events")
    with pytest.raises(EventDataError, match="'ros:///' names no topic of ROS"):
        open_live("ros:///", *SIZE)


def test_without_ros_it_is_said_how_to_get_it():
    with pytest.raises(ConfigError, match=r"no module 'rclpy'. It does not come by pip: install .*event-camera-msgs, run `source"):
        open_live("ros:///event_camera/events", *SIZE)


def received(source, messages) -> list:
    """What comes of messages that are all there."""
    for message in messages:
        source._on_packet(message)
    batches = []
    for batch in source.chunks():
        batches.append(batch)
        if sum(map(len, batches)) == COUNT:
            break
    return batches


def test_packets_become_events_and_times_of_ros(ros):
    source = open_live("ros:///event_camera/events", *SIZE)
    assert ros.topic == "/event_camera/events" and source.frame == "camera"
    events = random_events(COUNT, width=64, height=48)
    assert_same(concatenate(received(source, mono_packets(events, SIZE, AHEAD_US, 7))), events)
    assert source.frame == "event_camera"
    assert source.ros_time_ns(int(events.t_us[5])) == 1000 * (int(events.t_us[5]) + AHEAD_US)
    source.close()
    assert ros.ended == ["executor", "node", "shutdown"]


def test_packets_of_evt3_that_are_cut_anywhere(ros, tmp_path):
    events = random_events(COUNT, width=64, height=48)
    writer = Evt3Writer(tmp_path / "e.raw", *SIZE)
    writer.write(events)
    writer.close()
    data = (tmp_path / "e.raw").read_bytes()
    words = np.frombuffer(data[data.index(b"% end\n") + 6 :], "<u2")
    source = open_live("ros://event_camera/events", *SIZE)
    messages = [packet(words[start : start + 101], 1000 * AHEAD_US, SIZE) for start in range(0, len(words), 101)]
    assert_same(concatenate(received(source, messages)), events)


def test_packets_of_another_camera_are_refused(ros):
    source = open_live("ros:///event_camera/events", *SIZE)
    source._on_packet(packet(np.zeros(2, "<u2"), 0, (640, 480)))
    with pytest.raises(EventDataError, match="sends packets of 640x480 pixels, but the camera 64x48"):
        next(source.chunks())
    source = open_live("ros:///event_camera/events", *SIZE)
    source._on_packet(b"\0" * 9)
    with pytest.raises(EventDataError, match="sends what is no EventPacket"):
        next(source.chunks())


def test_a_run_publishes_poses_while_it_goes_on(ros, tmp_path):
    sequence = read_sequence(write_tiny_sequence(tmp_path, duration_us=30_000))
    obj = sequence.objects[0]
    events = concatenate(sequence.events.chunks())
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    start_us = int(events.t_us[0]) - 1
    pose = {"matrix": obj.ground_truth.at(torch.tensor([start_us]))[0]}
    config = RunConfig(
        source="ros:///event_camera/events",
        camera=camera,
        objects=[{"label": "box", "mesh": obj.model_path(), "initial_pose": pose}],
        output=tmp_path / "out",
        overlay={"enabled": False},
        end_us=int(events.t_us[-1]) - 1,
    )

    def send():
        while ros.callback is None:
            time.sleep(0.01)
        for message in mono_packets(events, (CAMERA.width, CAMERA.height), AHEAD_US, 12):
            ros.callback(message)

    sender = threading.Thread(target=send)
    sender.start()
    summary = run(config)
    sender.join()
    assert summary.events + summary.dropped_events == int((events.t_us <= config.end_us).sum())
    trajectory = read_tum(tmp_path / "out" / "trajectory_box.tum")
    poses = [message for topic, message in ros.published if topic == "/torchtrack/box/pose"]
    transforms = [message.transforms[0] for topic, message in ros.published if topic == "/tf"]
    assert len(poses) == len(transforms) == len(trajectory) == summary.windows >= 1
    # On a slow machine some are joined.
    assert summary.windows + summary.joined_windows + summary.dropped_windows >= 3
    stamps_us = [message.header.stamp.sec * 10**6 + message.header.stamp.nanosec // 1000 for message in poses]
    assert stamps_us == [t_us + AHEAD_US for t_us in trajectory.t_us.tolist()]
    positions = torch.tensor([[message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z] for message in poses])
    torch.testing.assert_close(positions.double(), trajectory.T_cam_obj[:, :3, 3], atol=1e-6, rtol=0)
    assert {message.header.frame_id for message in poses} == {"event_camera"}
    assert {transform.child_frame_id for transform in transforms} == {"box"}
    assert transforms[0].header.stamp == poses[0].header.stamp
    assert ros.ended == ["executor", "node", "shutdown"]

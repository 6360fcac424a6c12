"""Events from a topic of ROS 2 (``event_camera_msgs/msg/EventPacket``), and poses to topics, by rclpy where there is one.

A node ``torchtrack`` subscribes to the topic. Packets come as bytes and are decoded by :class:`torchtrack.io.ros_messages.MessageDecoder`,
as those of a bag are; all but the calls of rclpy is tested without ROS.
"""

import importlib
import threading
from collections import deque
from typing import Any

import numpy as np

from torchtrack.errors import ConfigError, EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.live_source import LiveSource
from torchtrack.io.ros_clock import PacketClock
from torchtrack.io.ros_messages import PACKETS, MessageDecoder
from torchtrack.io.ros_poses import NAMES

NODE = "torchtrack"
# Packets that may wait; a camera sends about a thousand in a second.
_QUEUE = 2000
_WAIT_S = 0.05


class RosSource(LiveSource):
    """Packets of a topic, and a node to publish with.

    Args:
        topic: its name, such as ``/event_camera/events``.
        width, height: sensor size (px); a packet of another is an error.

    Attributes:
        frame: the frame that the newest packet is of; ``camera`` before the first one, or where it names none.

    Raises:
        ConfigError: if there is no ROS 2 with event_camera_msgs in this Python.
    """

    def __init__(self, topic: str, width: int, height: int) -> None:
        super().__init__(f"ros://{topic}", width, height)
        self.frame = "camera"
        self._decoder = MessageDecoder(PACKETS, True, self.problems)
        self._clock = PacketClock()
        # What the mender has moved the times of the newest packet by (µs).
        self._mended_by_us = 0
        self._packets = deque[bytes](maxlen=_QUEUE)
        self._arrived = threading.Event()
        self._node = RosNode(topic, self._on_packet)

    def _on_packet(self, message: bytes) -> None:
        """Called by the node's own thread."""
        self._packets.append(bytes(message))
        self._arrived.set()

    def _receive(self) -> Columns | None:
        self._arrived.wait(_WAIT_S)
        self._arrived.clear()
        if not self._packets:
            return Columns.empty()
        message = self._packets.popleft()
        if self._packets:
            self._arrived.set()
        self._check_size(message)
        events = self._decoder.events([message])
        header = self._decoder.header(message)
        self.frame = header.frame or self.frame
        if len(events):
            self._clock.add(header.stamp_ns // 1000, int(events.t_us[0]))
        return events

    def _check_size(self, message: bytes) -> None:
        try:
            size = self._decoder.size(message)
        except EventDataError as error:
            raise EventDataError(f"'{self.name}' sends what is no EventPacket: {error}.") from error
        if size != (self.width, self.height):
            sizes = f"{size[0]}x{size[1]} pixels, but the camera {self.width}x{self.height}"
            raise EventDataError(f"'{self.name}' sends packets of {sizes}. Correct the calibration.")

    def _mended(self, received: Columns | None) -> list[Columns]:
        mended = super()._mended(received)
        newest = max((int(columns.t_us[-1]) for columns in mended if len(columns)), default=None)
        if received is not None and len(received) and newest is not None:
            self._mended_by_us = newest - int(np.max(received.t_us))
        return mended

    def ros_time_ns(self, t_us: int) -> int:
        """A time of the stream by the clock of ROS."""
        return 1000 * self._clock.ros_time_us(t_us - self._mended_by_us)

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message of rclpy."""
        self._node.publish(topic, message)

    @property
    def message_types(self) -> dict[str, Any]:
        """The types of rclpy that poses are made of, see :data:`torchtrack.io.ros_poses.NAMES`."""
        return {name: _message_type(kind) for name, kind in NAMES.items()}

    def close(self) -> None:
        """Take the node away."""
        self._node.close()


class RosNode:
    """The calls of rclpy: a node with one subscription, whose callback a thread of its own calls with the bytes of each message.

    Args:
        topic: what to subscribe to.
        on_message: called with each message.

    Raises:
        ConfigError: if rclpy or the messages are not there.
    """

    def __init__(self, topic: str, on_message: Any) -> None:
        self._rclpy, executors, qos, signals = (_module(name) for name in ("rclpy", "rclpy.executors", "rclpy.qos", "rclpy.signals"))
        packet = _message_type("event_camera_msgs/msg/EventPacket")
        # Ctrl-C ends a run in order: rclpy is not to take it.
        self._rclpy.init(signal_handler_options=signals.SignalHandlerOptions.NO)
        self._node = self._rclpy.create_node(NODE)
        # Drivers of cameras send as best effort; a subscriber that wants more would hear nothing.
        profile = qos.QoSProfile(depth=_QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(packet, topic, on_message, profile, raw=True)
        self._publishers: dict[str, Any] = {}
        self._executor = executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, name="torchtrack-ros", daemon=True).start()

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message; the topic begins with the first one."""
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(type(message), topic, 10)
        self._publishers[topic].publish(message)

    def close(self) -> None:
        """End thread and node."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._rclpy.try_shutdown()


def _message_type(kind: str) -> Any:
    """The class of rclpy of a kind of message, such as ``std_msgs/msg/Header``."""
    package, _, name = kind.split("/")
    return getattr(_module(f"{package}.msg"), name)


def _module(name: str) -> Any:
    """A module of ROS.

    Raises:
        ConfigError: if it is not there.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"source: 'ros://' needs ROS 2 with event_camera_msgs, but this Python has no module '{name}'. It does not come by pip: install "
            "ros-DISTRO-ros-base and ros-DISTRO-event-camera-msgs, run `source /opt/ros/DISTRO/setup.bash`, and use torchtrack with that Python."
        ) from error

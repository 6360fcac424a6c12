"""In the place of ROS: modules with the few calls of rclpy that are made, and messages of the types that rosbags knows."""

import itertools
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from torchtrack.core.events import EventBatch

PACKET = "event_camera_msgs/msg/EventPacket"
# Its fields, as the package documents them.
PACKET_FIELDS = """
std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg(PACKET_FIELDS, PACKET))


def packet(words: np.ndarray, stamp_ns: int, size: tuple[int, int], base_ns: int | None = None, frame: str = "event_camera") -> bytes:
    """The bytes of a packet as rosbags writes it: words of EVT3, or of ``mono`` where there is a time that they count from."""
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    message = STORE.types[PACKET](
        header=STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        height=size[1],
        width=size[0],
        seq=1,
        time_base=base_ns or 0,
        encoding="evt3" if base_ns is None else "mono",
        is_bigendian=False,
        events=np.frombuffer(words.tobytes(), np.uint8),
    )
    return bytes(STORE.serialize_cdr(message, PACKET))


def mono_packets(events: EventBatch, size: tuple[int, int], ahead_us: int, count: int) -> list[bytes]:
    """Events in so many packets, received ``ahead_us`` after their times by the camera's clock."""
    bounds = np.linspace(0, len(events), count + 1).astype(int)
    return [_mono_packet(events[start:end], size, ahead_us) for start, end in itertools.pairwise(bounds.tolist())]


def _mono_packet(events: EventBatch, size: tuple[int, int], ahead_us: int) -> bytes:
    first_us = int(events.t_us[0])
    t, x, y, p = (values.numpy().astype(np.uint64) for values in (events.t_us - first_us, events.x, events.y, events.polarity))
    words = t * np.uint64(1000) | x << np.uint64(32) | y << np.uint64(48) | p << np.uint64(63)
    return packet(words.astype("<u8"), 1000 * (first_us + ahead_us), size, 1000 * first_us)


class StandInRos:
    """What was subscribed to and published; :meth:`send` calls the subscriber as the thread of an executor does."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Any]] = []
        self.callback: Any = None
        self.topic = ""
        self.ended: list[str] = []
        self._stop = threading.Event()

    def install(self, monkeypatch) -> None:
        def module(name: str, **members: Any) -> None:
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(members)

        module("rclpy", init=self._init, create_node=lambda name: self, try_shutdown=lambda: self.ended.append("shutdown"))
        module("rclpy.executors", SingleThreadedExecutor=lambda: self)
        module("rclpy.qos", QoSProfile=SimpleNamespace, ReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort"))
        module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO="no"))
        for kind in [*STORE.types]:
            package, _, name = kind.split("/")
            module_name = f"{package}.msg"
            if module_name not in sys.modules:
                module(module_name)
            vars(sys.modules[module_name])[name] = STORE.types[kind]

    def _init(self, signal_handler_options: str) -> None:
        assert signal_handler_options == "no"

    def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any, raw: bool) -> None:
        assert kind is STORE.types[PACKET] and raw and profile.reliability == "best effort"
        self.topic, self.callback = topic, callback

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        def publish(message: Any) -> None:
            assert type(message) is kind
            self.published.append((topic, message))

        return SimpleNamespace(publish=publish)

    def add_node(self, node: Any) -> None:
        assert node is self

    def spin(self) -> None:
        self._stop.wait(60)

    def shutdown(self) -> None:
        self._stop.set()
        self.ended.append("executor")

    def destroy_node(self) -> None:
        self.ended.append("node")

"""ROS messages with events: every encoding, ROS 1 and ROS 2, and faults."""

import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything

from torchtrack.config.events import ReadingConfig
from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError, TorchtrackWarning, UnknownFormatError
from torchtrack.io import open_events
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.ros_messages import MessageDecoder


def header(ros2: bool) -> bytes:
    frame = b"cam\0" if ros2 else b"cam"
    stamp = np.array([1, 2], "<u4").tobytes()
    start = b"\0\1\0\0" if ros2 else np.array([7], "<u4").tobytes()
    return start + stamp + np.array([len(frame)], "<u4").tobytes() + frame


def padded(data: bytes, ros2: bool, size: int) -> bytes:
    return data + b"\0" * (-(len(data) - 4) % size) if ros2 else data


def event_array(events: EventBatch, ros2: bool) -> bytes:
    data = padded(header(ros2), ros2, 4) + np.array([48, 64, len(events)], "<u4").tobytes()
    for x, y, t, p in zip(events.x.tolist(), events.y.tolist(), events.t_us.tolist(), events.polarity.tolist(), strict=True):
        data = padded(data, ros2, 2) + np.array([x, y], "<u2").tobytes()
        data = padded(data, ros2, 4) + np.array([t // 10**6, t % 10**6 * 1000], "<u4").tobytes() + bytes([p])
    return data


def event_packet(encoding: str, content: bytes, base_ns: int, ros2: bool) -> bytes:
    data = padded(header(ros2), ros2, 4) + np.array([48, 64], "<u4").tobytes()
    data = padded(data, ros2, 8) + np.array([1, base_ns], "<u8").tobytes()
    name = encoding.encode() + b"\0" * ros2
    data += np.array([len(name)], "<u4").tobytes() + name + b"\0"
    return padded(data, ros2, 4) + np.array([len(content)], "<u4").tobytes() + content


@pytest.mark.parametrize("count", [0, 1, 2, 3, 100])
@pytest.mark.parametrize("ros2", [False, True])
def test_dvs_messages(ros2, count):
    decoder = MessageDecoder("EventArray", ros2, Problems("bag", strict=True))
    events = random_events(count, **SIZE) if count else EventBatch.empty()
    message = event_array(events, ros2)
    assert decoder.size(message) == (64, 48)
    assert_same(decoder.events([message]).batch(), events)


def mono(events: EventBatch, base_us: int) -> bytes:
    t, x, y, p = (values.numpy().astype(np.uint64) for values in (events.t_us - base_us, events.x, events.y, events.polarity))
    return (t * np.uint64(1000) | x << np.uint64(32) | y << np.uint64(48) | p << np.uint64(63)).astype("<u8").tobytes()


def libcaer(events: EventBatch, base_us: int) -> bytes:
    t, x, y, p = (values.numpy().astype(np.uint64) for values in (events.t_us - base_us, events.x, events.y, events.polarity))
    return (np.uint64(1) | p << np.uint64(1) | y << np.uint64(2) | x << np.uint64(17) | t << np.uint64(32)).astype("<u8").tobytes()


def libcaer_cmp(events: EventBatch, base_us: int) -> bytes:
    words = []
    for t, x, y, p in zip((events.t_us - base_us).tolist(), events.x.tolist(), events.y.tolist(), events.polarity.tolist(), strict=True):
        words += [t >> 12, 1 << 12 | t & 0xFFF, 2 << 12 | x, 3 << 12 | p << 11 | y]
    return np.array(words, "<u2").tobytes()


@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize("encode", [mono, libcaer, libcaer_cmp])
def test_packets_count_from_their_own_time(encode, ros2):
    events = random_events(200, **SIZE, duration_us=50_000)
    base_us = int(events.t_us[0]) - 3
    message = event_packet(encode.__name__, encode(events, base_us), base_us * 1000, ros2)
    assert_same(MessageDecoder("EventPacket", ros2, Problems("bag", strict=True)).events([message]).batch(), events)


def test_vectors_of_libcaer_stand_upright():
    words = np.array([0, 1 << 12 | 5, 2 << 12 | 9, 4 << 12 | 1 << 11 | 20, 5 << 12 | 0b101], "<u2")
    decoded = MessageDecoder("EventPacket", True, Problems("bag", strict=True)).events([event_packet("libcaer_cmp", words.tobytes(), 0, True)])
    assert (decoded.x.tolist(), decoded.y.tolist(), decoded.t_us.tolist(), decoded.polarity.tolist()) == ([9, 9], [20, 22], [5, 5], [True, True])


@pytest.mark.parametrize(("encoding", "content", "reason"), [("evt9", b"", "'evt9' is not known"), ("evt3", b"abc", "no multiple of 2")])
def test_messages_that_cannot_be_read_are_counted(encoding, content, reason):
    message = event_packet(encoding, content, 0, True)
    for broken, why in ((message, reason), (message[:30], "ends early")):
        problems = Problems("bag", strict=False)
        assert len(MessageDecoder("EventPacket", True, problems).events([broken])) == 0
        assert problems.counts == {Problem.DAMAGED: 1}
        with pytest.raises(EventDataError, match=why):
            MessageDecoder("EventPacket", True, Problems("bag", strict=True)).events([broken])


def test_a_bag_without_events(tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with rosbags.Writer(tmp_path / "e.bag") as writer:
        connection = writer.add_connection("/chatter", "std_msgs/msg/Int8", typestore=store)
        writer.write(connection, 1, b"\1")
    with pytest.raises(UnknownFormatError, match=r"no topic of events .*Its topics: /chatter \(std_msgs/msg/Int8\)"):
        open_events(tmp_path / "e.bag")


def events_bag(path, module, topics, **options):
    """A recording with a message of events in each topic, at times that tell them apart."""
    typesys = pytest.importorskip("rosbags.typesys")
    ros2 = module.__name__.endswith("2")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE if ros2 else typesys.Stores.ROS1_NOETIC)
    event = "uint16 x\nuint16 y\ntime ts\nbool polarity" if not ros2 else "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"
    array = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events"
    store.register(typesys.get_types_from_msg(event, "dvs_msgs/msg/Event"))
    store.register(typesys.get_types_from_msg(array, "dvs_msgs/msg/EventArray"))
    with module.Writer(path, **options) as writer:
        for number, topic in enumerate(topics):
            connection = writer.add_connection(topic, "dvs_msgs/msg/EventArray", typestore=store)
            writer.write(connection, 1 + number, event_array(at_us(number + 1), ros2))
    return path


def at_us(t_us: int) -> EventBatch:
    return EventBatch.from_numpy(np.array([5]), np.array([6]), np.array([t_us]), np.array([True]))


def test_one_of_several_topics_is_told_and_chosen(tmp_path):
    path = events_bag(tmp_path / "e.bag", pytest.importorskip("rosbags.rosbag1"), ["/left/events", "/right/events"])
    with pytest.warns(TorchtrackWarning, match="'/left/events' is read; the others are '/right/events'. Choose one with events.topic"):
        assert_same(everything(open_events(path)), at_us(1))
    assert_same(everything(open_events(path, choices=ReadingConfig(topic="/right/events"))), at_us(2))
    with pytest.raises(EventDataError, match="no events named '/up'; its streams of events are: /left/events, /right/events"):
        open_events(path, choices=ReadingConfig(topic="/up"))


def test_a_folder_without_its_list_is_read_in_the_order_of_its_files(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    folder = tmp_path / "recording"
    folder.mkdir()
    for number, name in ((1, "a_2.db3"), (2, "a_10.db3")):
        whole = events_bag(tmp_path / f"whole{number}", rosbag2, ["/other", "/events"][-number:], version=9)
        next(whole.glob("*.db3")).rename(folder / name)
    with pytest.warns(TorchtrackWarning, match=r"has no metadata.yaml: a_2.db3, a_10.db3 are read in this order. `ros2 bag reindex"):
        events = everything(open_events(folder))
    assert events.t_us.tolist() == [1, 2]


def cut(path, share: float):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    return path


def test_recordings_that_were_broken_off_come_with_advice_that_helps(tmp_path):
    bag = cut(events_bag(tmp_path / "e.bag", pytest.importorskip("rosbags.rosbag1"), ["/events"]), 0.6)
    with pytest.raises(EventDataError, match=r"e\.bag' is truncated or damaged .*`rosbag reindex .*e\.bag` writes the index"):
        open_events(bag)
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    folder = events_bag(tmp_path / "mcap", rosbag2, ["/events"], version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with pytest.raises(EventDataError, match=r"`mcap recover .*\.mcap -o recovered\.mcap` keeps what can be read"):
        open_events(cut(next(folder.glob("*.mcap")), 0.6))
    with pytest.raises(EventDataError, match="Try `ros2 bag reindex .*, or give one of its .db3 or .mcap files itself"):
        open_events(folder)

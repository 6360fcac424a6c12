"""Formats beside RAW: DAT, Event Stream, AEDAT4, HDF5, ROS messages, CSV; told by content, exact, honest about faults."""

import h5py
import numpy as np
import pytest
from helpers import random_events
from io_files import assert_same, everything, save_npz

from torchtrack.errors import EventDataError, MissingExtraError, TorchtrackWarning, UnknownFormatError
from torchtrack.events import EventBatch
from torchtrack.io import extras, open_events
from torchtrack.io.columns import Columns
from torchtrack.io.container import ContainerWriter
from torchtrack.io.hdf5 import Hdf5Events
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.ros_messages import MessageDecoder
from torchtrack.io.sequence import read_sequence
from torchtrack.io.writers.aedat4 import Aedat4Writer
from torchtrack.io.writers.hdf5 import Hdf5Writer

SIZE = {"width": 64, "height": 48}


@pytest.fixture
def events() -> EventBatch:
    return random_events(2000, **SIZE)


def arrays(events: EventBatch) -> dict[str, np.ndarray]:
    return {
        "x": events.x.numpy().astype(np.uint16),
        "y": events.y.numpy().astype(np.uint16),
        "t": events.t_us.numpy(),
        "p": events.polarity.numpy().astype(np.uint8),
    }


# ---- DAT


def dat_file(folder, words, header="% Version 2\n% Width 64\n% Height 48\n", kind=b"\x0c\x08"):
    (folder / "e.dat").write_bytes(header.encode() + kind + np.array(words, "<u8").tobytes())
    return folder / "e.dat"


def dat_word(t: int, x: int, y: int, p: int) -> int:
    return t | (x | y << 14 | p << 28) << 32


def test_dat_wraps_after_seventy_minutes(tmp_path):
    words = [dat_word(t % 2**32, 1, 2, 1) for t in (2**32 - 5, 2**32 + 3, 2**32 + 2**31 + 9, 2**33 + 1)]
    assert everything(open_events(dat_file(tmp_path, words))).t_us.tolist() == [2**32 - 5, 2**32 + 3, 2**32 + 2**31 + 9, 2**33 + 1]


@pytest.mark.parametrize(("header", "kind"), [("% Version 1\n", b"\x0c\x08"), ("% Version 2\n", b"\x0e\x08"), ("% Version 2\n", b"\x0c\x10")])
def test_dat_files_that_are_not_known(tmp_path, header, kind):
    with pytest.raises(UnknownFormatError):
        open_events(dat_file(tmp_path, [], header, kind))


def test_dat_that_ends_within_an_event(tmp_path):
    path = dat_file(tmp_path, [dat_word(1, 1, 1, 0)])
    path.write_bytes(path.read_bytes() + b"\0\0\0")
    source = open_events(path)
    with pytest.warns(TorchtrackWarning, match="ends within a word: 3 bytes"):
        assert len(everything(source)) == 1
    assert source.known_count == 1


# ---- Event Stream


def es_file(folder, body: bytes, kind: int = 1):
    (folder / "e.es").write_bytes(b"Event Stream\x02\x00\x00" + bytes([kind]) + np.array([320, 300], "<u2").tobytes() + body)
    return folder / "e.es"


def test_long_delays_and_empty_bytes_of_a_dvs(tmp_path):
    # The addresses 254 and 255 of the second event are no codes.
    body = bytes([5 << 1 | 1, 3, 0, 4, 0, 255, 255, 254, 7 << 1, 254, 0, 255, 0, 255, 1 << 1, 63, 0, 47, 0])
    events = everything(open_events(es_file(tmp_path, body), strict=True))
    rows = list(zip(*(values.tolist() for values in (events.t_us, events.x, events.y, events.polarity)), strict=True))
    assert rows == [(5, 3, 4, True), (5 + 2 * 127 + 7, 254, 255, False), (5 + 2 * 127 + 7 + 127 + 1, 63, 47, False)]


def test_an_atis_has_exposures_that_are_left_out(tmp_path):
    body = bytes([1 << 2 | 2, 1, 0, 2, 0, 0b11111101, 2 << 2 | 1, 9, 0, 9, 0, 3 << 2, 4, 0, 5, 0])
    events = everything(open_events(es_file(tmp_path, body, 2), strict=True))
    assert (events.t_us.tolist(), events.x.tolist(), events.polarity.tolist()) == ([1, 1 + 63 + 2 + 3], [1, 4], [True, False])


def test_event_streams_that_are_not_known(tmp_path):
    with pytest.raises(UnknownFormatError, match="DVS"):
        open_events(es_file(tmp_path, b"", 4))


# ---- AEDAT4


def test_a_damaged_packet_costs_that_packet(tmp_path):
    pytest.importorskip("dv_processing")
    pytest.importorskip("lz4")
    events = random_events(50_000, **SIZE)
    path = tmp_path / "e.aedat4"
    writer = Aedat4Writer(path, 64, 48)
    writer.write(events)
    writer.close()
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = b"\xff" * 40
    path.write_bytes(content)
    with pytest.raises(EventDataError, match="Copy it again"):
        everything(open_events(path, strict=True))
    source = open_events(path)
    with pytest.warns(TorchtrackWarning, match="damaged"):
        found = everything(source)
    assert 30_000 <= len(found) < 50_000


def test_a_truncated_file_gives_what_is_there(tmp_path):
    pytest.importorskip("dv_processing")
    pytest.importorskip("lz4")
    path = tmp_path / "e.aedat4"
    writer = Aedat4Writer(path, 64, 48)
    writer.write(random_events(50_000, **SIZE))
    writer.close()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(TorchtrackWarning, match="ends within a packet"):
        assert 10_000 <= len(everything(open_events(path))) < 50_000


def test_aedat4_files_have_their_suffix(tmp_path):
    pytest.importorskip("dv_processing")
    with pytest.raises(EventDataError, match=r"are named \.aedat4"):
        Aedat4Writer(tmp_path / "e.dat", 64, 48)


def test_a_missing_library_is_named(tmp_path, data_dir, monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(extras.importlib, "import_module", missing)
    for name, extra in (("dvxplorer_sample.aedat4", "aedat"), ("event_camera_msgs_evt3.bag", "ros")):
        with pytest.raises(MissingExtraError, match=rf"pip install 'torchtrack\[{extra}\]'"):
            open_events(data_dir / "recordings" / name)


# ---- HDF5


def hdf5_file(folder, group: str, content: dict, **attributes):
    with h5py.File(folder / "e.h5", "w") as file:
        for name, values in content.items():
            file[f"{group}/{name}"] = values
        file.attrs.update(attributes)
    return folder / "e.h5"


@pytest.mark.parametrize("group", ["events", "prophesee/left", "/"])
def test_groups_that_hold_events(tmp_path, events, group):
    source = open_events(hdf5_file(tmp_path, group, arrays(events), **SIZE))
    assert (source.width, source.height) == (64, 48)
    assert_same(everything(source), events)


def test_seconds_are_rounded_to_the_nearest_microsecond(tmp_path, events):
    content = arrays(events)
    seconds = {"xs": content["x"], "ys": content["y"], "ts": 1e-6 * content["t"], "ps": content["p"] > 0}
    source = open_events(hdf5_file(tmp_path, "events", seconds, sensor_resolution=[48, 64]))
    assert_same(everything(source, 99), events)


def test_dsec_without_a_size_is_vga(tmp_path, events):
    path = hdf5_file(tmp_path, "events", arrays(events))
    with h5py.File(path, "a") as file:
        file["t_offset"] = np.int64(10**12)
    source = open_events(path)
    assert (source.width, source.height) == (640, 480)
    assert int(everything(source).t_us[0]) == int(events.t_us[0]) + 10**12


def test_the_table_of_milliseconds_is_as_dsec_has_it(tmp_path, events):
    writer = Hdf5Writer(tmp_path / "e.h5", 64, 48)
    for start in range(0, len(events), 300):
        writer.write(events[start : start + 300])
    writer.close()
    with h5py.File(tmp_path / "e.h5") as file:
        t, table = file["events/t"][()], file["ms_to_idx"][()]
    assert table.tolist() == np.searchsorted(t, 1000 * np.arange(len(table))).tolist()
    assert len(table) == t[-1] // 1000 + 1
    for t_us in (0, 1, 4999, 5000, 10**6):
        assert_same(everything(Hdf5Events(tmp_path / "e.h5").seek(t_us)), events[events.t_us >= t_us])


def test_prophesee_records_and_their_filter(tmp_path, events):
    content = arrays(events)
    records = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in ("x", "y", "p", "t"):
        records[name] = content[name]
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["CD/events"] = records
        file.attrs["geometry"] = "64x48"
    source = open_events(tmp_path / "e.h5")
    assert (source.width, source.height) == (64, 48)
    assert_same(everything(source), events)
    if h5py.h5z.filter_avail(0x8ECF):
        pytest.skip("the filter ECF is installed")
    with h5py.File(tmp_path / "ecf.h5", "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((16384,))
        # Optional: what is created may lack it; a file of Prophesee's has it in the same place.
        plist.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        h5py.h5d.create(file.create_group("CD").id, b"events", h5py.h5t.py_create(records.dtype), h5py.h5s.create_simple((20_000,)), plist)
    with pytest.raises(EventDataError, match=r"ECF, which is not installed.*github\.com/prophesee-ai/hdf5_ecf.*HDF5_PLUGIN_PATH"):
        open_events(tmp_path / "ecf.h5")


def test_files_compressed_as_dsec_is(tmp_path, events):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, values in arrays(events).items():
            file.create_dataset(f"events/{name}", data=values, **hdf5plugin.Blosc(cname="zstd"))
    assert_same(everything(open_events(tmp_path / "e.h5", strict=True)), events)


@pytest.mark.parametrize(
    ("group", "content", "error", "reason"),
    [
        ("images", {"left": [1]}, UnknownFormatError, "without events that are known.*It holds: images"),
        ("events", {"x": [1], "y": [1], "t": [1, 2], "p": [1]}, EventDataError, "of one length"),
        ("events", {"x": [[1]], "y": [[1]], "t": [[1]], "p": [[1]]}, EventDataError, "must be flat"),
        ("events", {"x": [1.5], "y": [1], "t": [1], "p": [1]}, EventDataError, "pixels are not whole"),
        ("events", {"x": [1], "y": [1], "t": [np.nan], "p": [1]}, EventDataError, "not finite"),
        ("events", {"x": ["a"], "y": [1], "t": [1], "p": [1]}, EventDataError, "'x' must hold numbers"),
    ],
)
def test_hdf5_files_that_are_wrong(tmp_path, group, content, error, reason):
    with pytest.raises(error, match=reason):
        everything(open_events(hdf5_file(tmp_path, group, content), strict=True))


def test_a_sequence_of_a_later_version(tmp_path):
    writer = ContainerWriter(tmp_path / "e.h5", read_camera())
    writer.file.attrs["version"] = 2
    writer.close()
    with pytest.raises(EventDataError, match="version 2, but version 1 is known"):
        read_sequence(tmp_path / "e.h5")


def read_camera():
    from tiny_sequence import CAMERA

    return CAMERA


# ---- ROS messages


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
    found = MessageDecoder("EventPacket", True, Problems("bag", strict=True)).events([event_packet("libcaer_cmp", words.tobytes(), 0, True)])
    assert (found.x.tolist(), found.y.tolist(), found.t_us.tolist(), found.polarity.tolist()) == ([9, 9], [20, 22], [5, 5], [True, True])


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


# ---- CSV


ROWS = [(1_000_000, 3, 4, 1), (1_000_007, 63, 47, 0), (2_000_000, 0, 0, 1)]


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y,p\n" + "".join(f"{t},{x},{y},{p}\n" for t, x, y, p in ROWS),
        "".join(f"{t},{x},{y},{p}\r\n" for t, x, y, p in ROWS),
        "".join(f"{x},{y},{p},{t}\n" for t, x, y, p in ROWS),
        "polarity,timestamp,x,y\n" + "".join(f"{p},{t},{x},{y}\n" for t, x, y, p in ROWS),
        "t,x,y,p\n" + "".join(f"{t / 1e6:.6f},{x},{y},{p or -1}\n" for t, x, y, p in ROWS),
        "# comment\nx;y;p;t\n\n" + "".join(f" {x}; {y}; {p}; {t}\n" for t, x, y, p in ROWS).rstrip(),
    ],
    ids=["named", "plain", "metavision", "other names", "seconds", "semicolons"],
)
def test_csv(tmp_path, text):
    (tmp_path / "e.data").write_bytes(text.encode())
    events = everything(open_events(tmp_path / "e.data", **SIZE, strict=True))
    assert list(zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.polarity.int().tolist(), strict=True)) == ROWS


def test_csv_lines_that_cannot_be_read(tmp_path):
    (tmp_path / "e.csv").write_text("# width=64 height=48\nt,x,y,p\n1,2,3,1\n2,2,3\n3,a,3,1\n4,2,3,1\n9999999999999999999999,1,1,1\n")
    with pytest.raises(EventDataError, match="line 4: expected t, x, y and polarity, got '2,2,3': it has 3 columns"):
        everything(open_events(tmp_path / "e.csv", strict=True))
    source = open_events(tmp_path / "e.csv")
    with pytest.warns(TorchtrackWarning, match="First of 3 entries that cannot be read"):
        assert everything(source).t_us.tolist() == [1, 4]


def test_csv_without_a_size(tmp_path):
    (tmp_path / "e.csv").write_text("t,x,y,p\n1,2,3,1\n")
    with pytest.raises(EventDataError, match="does not say the sensor's width"):
        open_events(tmp_path / "e.csv")


def test_a_csv_of_something_else(tmp_path):
    (tmp_path / "e.csv").write_text("name,colour\nmug,red\n")
    with pytest.raises(EventDataError, match="expected lines 't,x,y,p' or 'x,y,p,t'"):
        open_events(tmp_path / "e.csv")


# ---- what is common


def test_lenient_reading_keeps_what_is_good(tmp_path):
    t = np.array([10, 20, 5, 30, 30, 2, 40])
    x = np.array([1, 1, 1, 64, 1, 1, 1])
    batch = EventBatch.from_numpy(x, np.ones(7, np.int64), t, np.ones(7))
    path = save_npz(tmp_path / "e.npz", batch)
    source = open_events(path)
    with pytest.warns(TorchtrackWarning):
        assert everything(source).t_us.tolist() == [10, 20, 30, 40]
    assert source.problems.counts == {Problem.OUTSIDE: 1, Problem.BACK: 2}
    assert str(source.problems) == "1 events outside the sensor, 2 events that go back in time"


def test_columns_of_a_batch():
    events = random_events(10, **SIZE)
    assert_same(Columns.of(events).batch(), events)
    assert len(Columns.empty()) == 0

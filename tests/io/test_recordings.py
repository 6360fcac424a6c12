"""Recordings of real cameras: every event of them, as independent decoders agreed on."""

import zipfile

import pytest
from io_files import assert_same, everything

from torchtrack.io import open_events

# name, sensor, events, first and last µs, sums of x and y
FACTS = [
    ("evt3_sample.raw", (1280, 720), 219_596, 11718656, 11727457, 159113225, 85638051),
    ("evt2_sample.raw", (640, 480), 539_481, 1317888, 1367888, 171811022, 110162026),
    ("ncars_sample.dat", (304, 240), 2_009, 0, 99952, 93457, 40463),
    ("dvxplorer_sample.aedat4", (320, 240), 111_954, 1605537493718345, 1605537494308262, 18342405, 15105898),
    ("event_camera_msgs_evt3.bag", (640, 480), 343_474, 7139845, 9218023, 116731888, 80879209),
    ("event_camera_msgs_evt3_ros2", (640, 480), 343_474, 7139845, 9218023, 116731888, 80879209),
    ("event_camera_msgs_evt3_ros2/test_events_1.db3", (640, 480), 343_474, 7139845, 9218023, 116731888, 80879209),
    ("dvs_sample.es", (320, 240), 473_225, 0, 999000, 72946016, 57092979),
    ("slider_depth/events.txt", (240, 180), 50_000, 3811, 174156, None, None),
    ("shapes_rotation/events.txt", (240, 180), 20_000, 2097134, 2195729, None, None),
]
LIBRARY = {"aedat4": "lz4.frame", "bag": "rosbags", "db3": "rosbags", "event_camera_msgs_evt3_ros2": "rosbags"}


@pytest.fixture(params=FACTS, ids=[fact[0] for fact in FACTS])
def recording(request, data_dir):
    name, *facts = request.param
    if library := LIBRARY.get(name.rpartition(".")[2]):
        pytest.importorskip(library)
    return data_dir / "recordings" / name, facts


def test_every_event_is_read(recording):
    path, (size, count, first_us, last_us, sum_x, sum_y) = recording
    source = open_events(path, strict=True)
    events = everything(source)
    assert (source.width, source.height) == size
    assert len(events) == count
    assert events.t_us[[0, -1]].tolist() == [first_us, last_us]
    if sum_x is not None:
        assert (int(events.x.sum()), int(events.y.sum())) == (sum_x, sum_y)


def test_chunks_of_another_size_hold_the_same_events(recording):
    path, _ = recording
    assert_same(everything(open_events(path), 777), everything(open_events(path)))


def test_seeking_gives_the_rest_of_the_stream(recording):
    path, (_, _, first_us, last_us, *_) = recording
    events = everything(open_events(path))
    for t_us in (first_us - 10**6, first_us, (first_us + last_us) // 2, last_us, last_us + 1):
        later = everything(open_events(path).seek(t_us))
        assert_same(later, events[events.t_us >= t_us])


def test_info_says_what_is_in_it(recording):
    path, (size, count, first_us, last_us, *_) = recording
    info = open_events(path).info()
    assert ((info.width, info.height), info.count, info.first_us, info.last_us) == (size, count, first_us, last_us)
    assert info.complete
    assert info.problems == {}
    assert 0.2 < info.brighter_share < 0.8


def test_counts_are_estimated_where_not_all_is_read(recording):
    path, (_, count, *_) = recording
    info = open_events(path).info(max_events=100)
    assert not info.complete
    assert info.count is None or 0.9 * count <= info.count <= 1.1 * count


def test_zipped_davis_text(data_dir, tmp_path):
    path = data_dir / "recordings" / "shapes_rotation" / "events.txt"
    with zipfile.ZipFile(tmp_path / "shapes_rotation.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "shapes_rotation/events.txt")
        archive.writestr("shapes_rotation/calib.txt", "1 2 3 4")
    assert_same(everything(open_events(tmp_path / "shapes_rotation.zip")), everything(open_events(path)))


def test_mcap(data_dir, tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    source = data_dir / "recordings" / "event_camera_msgs_evt3_ros2"
    with rosbag2.Reader(source) as reader, rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        known = reader.connections[0]
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        definition = (
            "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events"
        )
        store.register(typesys.get_types_from_msg(definition, known.msgtype))
        connection = writer.add_connection(known.topic, known.msgtype, typestore=store)
        for _, t_ns, message in reader.messages():
            writer.write(connection, t_ns, message)
    expected = everything(open_events(source))
    assert_same(everything(open_events(tmp_path / "bag", strict=True)), expected)
    assert_same(everything(open_events(next((tmp_path / "bag").glob("*.mcap")), strict=True)), expected)

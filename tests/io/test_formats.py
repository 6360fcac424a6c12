"""DAT, Event Stream, AEDAT4 and CSV; and what is left out where something is wrong."""

import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything, save_npz

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError, MissingExtraError, TorchtrackWarning, UnknownFormatError
from torchtrack.io import extras, open_events
from torchtrack.io.columns import Columns
from torchtrack.io.problems import Problem
from torchtrack.io.writers.aedat4 import Aedat4Writer

# ---- DAT


def dat_file(folder, words, header="% Version 2\n% Width 64\n% Height 48\n", kind=b"\x0c\x08"):
    (folder / "e.dat").write_bytes(header.encode() + kind + np.array(words, "<u8").tobytes())
    return folder / "e.dat"


def dat_word(t: int, x: int, y: int, p: int) -> int:
    return t | (x | y << 14 | p << 28) << 32


def test_dat_wraps_after_seventy_minutes(tmp_path):
    times = [start + number for start in (2**32 - 5, 2**32 + 30, 2**32 + 2**31 + 90, 2**33 + 10) for number in range(20)]
    words = [dat_word(t % 2**32, 1, 2, 1) for t in times]
    assert everything(open_events(dat_file(tmp_path, words), strict=True)).t_us.tolist() == times


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
        events_read = everything(source)
    assert 30_000 <= len(events_read) < 50_000


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
        assert everything(source).t_us.tolist() == [2, 5, 10, 20, 30, 40]
    assert source.problems.counts == {Problem.OUTSIDE: 1, Problem.SORTED: 2}
    assert str(source.problems) == "1 events outside the sensor, 2 events that came late, sorted in"


@pytest.mark.parametrize("size", [1, 2, 4, 5, 100])
def test_a_wild_time_at_the_end_of_a_part_costs_one_event(tmp_path, size):
    t = np.array([1, 2, 3, 100_000, 4, 5, 6, 7, 8])
    ones = np.ones(9, np.int64)
    source = open_events(save_npz(tmp_path / "e.npz", EventBatch.from_numpy(ones, ones, t, ones)))
    with pytest.warns(TorchtrackWarning, match="1 events far ahead of those before and after them: time goes back from 100000 to 4 µs at event 4"):
        assert everything(source, size).t_us.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]


def test_columns_of_a_batch():
    events = random_events(10, **SIZE)
    assert_same(Columns.from_batch(events).batch(), events)
    assert len(Columns.empty()) == 0

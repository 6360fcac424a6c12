"""Event files: DAVIS text and npz, opened by content, checked as they are streamed, in constant memory."""

import math
import tracemalloc
import zipfile
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import random_events
from torchtrack.errors import EventDataError, MissingFileError, UnknownFormatError
from torchtrack.events import EventBatch, concatenate
from torchtrack.io import DavisTextEvents, EventSource, NpzEvents, davis_text, open_events

SIZE = {"width": 64, "height": 48}


def save_npz(path, events: EventBatch, compressed: bool = False, **changes):
    arrays = {
        "t": events.t_us.numpy(),
        "x": events.x.numpy().astype(np.uint16),
        "y": events.y.numpy().astype(np.uint16),
        "p": events.polarity.numpy().astype(np.uint8),
        "width": np.int64(64),
        "height": np.int64(48),
        **changes,
    }
    (np.savez_compressed if compressed else np.savez)(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def save_text(path, text: str):
    path.write_text(text)
    return path


def everything(source: EventSource, max_events: int = 500_000) -> EventBatch:
    return concatenate(source.chunks(max_events))


def assert_same(events: EventBatch, expected: EventBatch) -> None:
    for name in ("x", "y", "t_us", "polarity", "stream_index"):
        assert torch.equal(getattr(events, name), getattr(expected, name)), name


# ---- recordings


def test_shapes_rotation(data_dir):
    source = open_events(data_dir / "recordings" / "shapes_rotation" / "events.txt")
    events = everything(source)
    assert (source.width, source.height) == (240, 180)
    assert len(events) == 20_000
    assert events.t_us[[0, 1, -1]].tolist() == [2097134, 2097140, 2195729]
    assert (int(events.x[0]), int(events.y[0]), bool(events.polarity[0])) == (162, 27, False)
    assert (int(events.x[-1]), int(events.y[-1]), bool(events.polarity[-1])) == (127, 147, True)


def test_slider_depth(data_dir):
    events = everything(open_events(data_dir / "recordings" / "slider_depth" / "events.txt"))
    assert len(events) == 50_000
    assert events.t_us[[0, -1]].tolist() == [3811, 174156]


def test_recordings_agree_with_exact_fractions(data_dir):
    path = data_dir / "recordings" / "shapes_rotation" / "events.txt"
    expected = [math.floor(Fraction(line.split()[0]) * 1_000_000 + Fraction(1, 2)) for line in path.read_text().splitlines()]
    assert everything(open_events(path)).t_us.tolist() == expected


@pytest.mark.parametrize(
    ("name", "count"),
    [("ape_messy", 775078), ("ape_normal", 741733), ("bunny_normal", 1184514), ("lbracket_normal", 1252254), ("three_normal", 2738322)],
)
def test_sequences_as_events(data_dir, name, count):
    source = open_events(data_dir / "sequences" / f"{name}.npz")
    assert (source.width, source.height) == (640, 480)
    assert sum(len(chunk) for chunk in source.chunks()) == count


@pytest.mark.parametrize("name", ["evt3_sample.raw", "ncars_sample.dat", "dvs_sample.es", "planar_square_flip.mat"])
def test_formats_that_are_not_read_yet(data_dir, name):
    with pytest.raises(UnknownFormatError, match=r"Supported: .*npz.*DAVIS text"):
        open_events(data_dir / "recordings" / name)


# ---- the common interface


@pytest.fixture(params=["text", "npz", "npz_compressed"])
def written(request, tmp_path) -> tuple[EventSource, EventBatch]:
    """A file of each kind, with the events that were written to it."""
    events = random_events(1000, **SIZE)
    if request.param == "text":
        rows = zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.polarity.int().tolist(), strict=True)
        path = save_text(tmp_path / "events.txt", "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in rows))
        return open_events(path, **SIZE), events
    path = save_npz(tmp_path / "events.npz", events, compressed=request.param == "npz_compressed")
    return open_events(path), events


@pytest.mark.parametrize("max_events", [1, 7, 500, 1000, 10**6])
def test_chunks_together_are_the_stream(written, max_events):
    source, expected = written
    chunks = list(source.chunks(max_events))
    assert all(0 < len(chunk) <= max_events for chunk in chunks)
    assert_same(concatenate(chunks), expected)


def test_a_source_may_be_read_again(written):
    source, expected = written
    next(source.chunks(10))
    assert_same(everything(source), expected)
    assert isinstance(source, EventSource)
    assert (source.width, source.height) == (64, 48)


def test_chunks_hold_at_least_one_event(written):
    with pytest.raises(EventDataError, match="max_events must be at least 1, got 0"):
        written[0].chunks(0)


def test_content_decides_not_the_suffix(written, tmp_path):
    source, expected = written
    disguised = source.path.rename(tmp_path / "events.raw")
    assert_same(everything(open_events(disguised, **SIZE)), expected)


@pytest.mark.parametrize("max_events", [2, 3, 100])
@pytest.mark.parametrize("kind", ["text", "npz"])
def test_time_that_goes_back_is_found_within_and_across_chunks(tmp_path, kind, max_events, monkeypatch):
    t_us = [10, 20, 30, 25, 40]
    monkeypatch.setattr(davis_text, "_BLOCK_BYTES", max_events * len("0.000010 1 2 1\n"))
    if kind == "text":
        source = open_events(save_text(tmp_path / "e.txt", "".join(f"0.0000{t} 1 2 1\n" for t in t_us)))
    else:
        ones = np.ones(5, dtype=np.uint16)
        source = open_events(save_npz(tmp_path / "e.npz", EventBatch.from_numpy(ones, ones, np.array(t_us), ones)))
    with pytest.raises(EventDataError, match=r"e\.(txt|npz): time goes back from 30 to 25 µs at event 3"):
        list(source.chunks(max_events))


@pytest.mark.parametrize("kind", ["text", "npz"])
def test_events_outside_the_sensor_are_found(tmp_path, kind):
    if kind == "text":
        source = open_events(save_text(tmp_path / "e.txt", "0.1 10 10 1\n0.2 240 10 0\n"))
    else:
        x, y = np.array([10, 240]), np.array([10, 10])
        path = save_npz(tmp_path / "e.npz", EventBatch.from_numpy(x, y, x, y), width=None, height=None)
        source = open_events(path, width=240, height=180)
    with pytest.raises(EventDataError, match=r"event 1 is at \(240, 10\), outside the sensor of 240x180"):
        list(source.chunks())


@pytest.mark.parametrize("text", ["", "\n\n", "# no events\n"])
def test_a_stream_without_events_yields_nothing(tmp_path, text):
    assert list(open_events(save_text(tmp_path / "e.txt", text)).chunks()) == []


def test_an_npz_without_events_yields_nothing(tmp_path):
    assert list(open_events(save_npz(tmp_path / "e.npz", EventBatch.empty())).chunks()) == []


# ---- open_events: errors


@pytest.mark.parametrize("opener", [open_events, NpzEvents, DavisTextEvents])
def test_missing_file(tmp_path, opener):
    with pytest.raises(MissingFileError, match=r"nowhere\.txt' does not exist"):
        opener(tmp_path / "nowhere.txt")


def test_a_folder_is_no_event_file(tmp_path):
    with pytest.raises(UnknownFormatError, match="is not a file"):
        open_events(tmp_path)


@pytest.mark.parametrize("content", [b"% Date 2020\n% evt 3.0\n\x01\x02", b"\x89HDF\r\n", b"t,x,y,p\n1,2,3,1\n", b"0.1 2 3 1\n\x00\x00"])
def test_unknown_formats_list_the_known_ones(tmp_path, content):
    (tmp_path / "events.bin").write_bytes(content)
    with pytest.raises(UnknownFormatError, match=r"events\.bin' is in no known event format .*Supported: numpy \.npz .*, DAVIS text"):
        open_events(tmp_path / "events.bin")


@pytest.mark.parametrize("size", [{"width": 240}, {"height": 180}, {"width": -1, "height": 5}])
def test_half_a_sensor_size_is_refused(tmp_path, size):
    path = save_text(tmp_path / "e.txt", "0.1 1 1 1\n")
    with pytest.raises(EventDataError, match="sensor size must be positive"):
        open_events(path, **size)


# ---- DAVIS text

digits = st.integers(0, 12).flatmap(lambda places: st.integers(0, 10**places - 1).map(lambda value: f"{value:0{places}d}" if places else ""))
seconds = st.tuples(st.integers(0, 2000), digits).map(lambda parts: f"{parts[0]}.{parts[1]}" if parts[1] else str(parts[0]))
blanks = st.sampled_from([" ", "  ", "\t", " \t "])
oddities = st.sampled_from(["", "", "", "# comment", "   ", "\r"])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(seconds, st.integers(0, 63), st.integers(0, 47), st.integers(0, 1), blanks, oddities), max_size=40), st.integers(64, 400))
def test_text_agrees_with_exact_fractions_however_it_is_laid_out(tmp_path_factory, rows, block_bytes):
    rows = sorted(rows, key=lambda row: Fraction(row[0]))
    text = "0.0 0 0 0\n" + "".join(f"{odd}\n{t}{blank}{x} {y}{blank}{p}{' ' if odd else ''}\n" for t, x, y, p, blank, odd in rows)
    path = save_text(tmp_path_factory.mktemp("text") / "events.txt", text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(davis_text, "_BLOCK_BYTES", block_bytes)
        patch.setattr(davis_text, "_FEW_BYTES", 32)
        events = everything(open_events(path, **SIZE))[1:]
    assert events.t_us.tolist() == [math.floor(Fraction(row[0]) * 1_000_000 + Fraction(1, 2)) for row in rows]
    assert list(zip(events.x.tolist(), events.y.tolist(), events.polarity.int().tolist(), strict=True)) == [row[1:4] for row in rows]


@pytest.mark.parametrize(
    "line", ["1e-3 1 2 1", ".001 1 2 1", "0.00100000049 1 2 1", "  0.001\t1   2 1  ", "0.001 1.0 2.0 1", "0.001 1 2 1 # remark", "0.001 1 2 1\r"]
)
def test_other_ways_to_write_the_same_event(tmp_path, line):
    events = everything(open_events(save_text(tmp_path / "e.txt", f"{line}\n")))
    assert_same(events, EventBatch.from_numpy(*(np.array([value]) for value in (1, 2, 1000, 1))))


def test_polarity_may_be_minus_one_and_time_negative(tmp_path):
    events = everything(open_events(save_text(tmp_path / "e.txt", "-0.5 1 2 -1\n0.5 1 2 1\n")))
    assert events.polarity.tolist() == [False, True]
    assert events.t_us.tolist() == [-500_000, 500_000]


def test_the_last_line_needs_no_newline(tmp_path):
    assert len(everything(open_events(save_text(tmp_path / "e.txt", "0.1 1 2 1\n0.2 1 2 1")))) == 2


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("0.5 1 2", "it has 3 columns"),
        ("0.5 1 2 1 7", "it has 5 columns"),
        ("0.5 1 2 2", "polarity 2"),
        ("0.5 1.5 2 1", r"'1\.5' is not a whole number"),
        ("0.5 1 99999999999 1", "'99999999999' is not a whole number"),
        ("0.5 nan 2 1", "'nan' is not a whole number"),
        ("0.5 one 2 1", "'one'"),
        ("0.5.5 1 2 1", r"'0\.5\.5' is not a number"),
        ("inf 1 2 1", "'inf' is not a time"),
        ("0.5 1_0 2 1", "underscores"),
        ("9999999999999999.0 1 2 1", "64 bits"),
    ],
)
def test_malformed_lines_are_named_with_number_and_content(tmp_path, line, reason):
    plain = "".join(f"0.{i:06d} 1 2 1\n" for i in range(300))
    path = save_text(tmp_path / "e.txt", f"# comment\n\n{plain}{line}\n{plain}")
    with pytest.raises(EventDataError, match=rf"e\.txt, line 303: expected 't x y p' .*, got '{line}': .*{reason}"):
        list(open_events(path).chunks())


def test_a_malformed_first_line_is_reported_when_the_file_is_opened(tmp_path):
    path = save_text(tmp_path / "e.txt", "# t x y p\nt x y p\n")
    with pytest.raises(EventDataError, match=r"line 2: expected 't x y p' .*, got 't x y p'"):
        open_events(path)


def test_microseconds_in_place_of_seconds_are_noticed(tmp_path):
    path = save_text(tmp_path / "e.txt", "2097134 1 2 1\n2097140 1 2 1\n2097141 1 2 1\n")
    with pytest.raises(EventDataError, match=r"have no decimals, but DAVIS text has seconds\. Divide"):
        open_events(path)


def test_endless_lines_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(davis_text, "_BLOCK_BYTES", 100)
    path = save_text(tmp_path / "e.txt", "0.1 1 2 1\n" + "0.1 1 2 1 " * 50)
    with pytest.raises(EventDataError, match="a line is longer than 100 bytes"):
        list(open_events(path).chunks())


def test_text_is_streamed_in_constant_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(davis_text, "_BLOCK_BYTES", 1 << 14)
    path = save_text(tmp_path / "e.txt", "".join(f"0.{i:06d} {i % 240} {i % 180} {i % 2}\n" for i in range(100_000)))
    assert peak_bytes(open_events(path), 10_000) < 600_000


# ---- npz


def peak_bytes(source: EventSource, max_events: int) -> int:
    tracemalloc.start()
    try:
        count = sum(len(chunk) for chunk in source.chunks(max_events))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count >= 100_000
    return peak


@pytest.mark.parametrize("compressed", [False, True], ids=["stored", "compressed"])
def test_npz_is_streamed_in_constant_memory(tmp_path, compressed):
    count = 1_000_000
    t_us = np.arange(count)
    path = save_npz(tmp_path / "e.npz", EventBatch.from_numpy(t_us % 64, t_us % 48, t_us, t_us % 2), compressed)
    arrays_bytes = count * (8 + 2 + 2 + 1)
    assert peak_bytes(open_events(path), 10_000) < arrays_bytes / 10


@pytest.mark.parametrize("integer", ["<i8", ">i8", "<u8", "<i4"])
def test_npz_integers_of_any_size_and_order(tmp_path, integer):
    events = random_events(100, **SIZE)
    path = save_npz(tmp_path / "e.npz", events, t=events.t_us.numpy().astype(integer), x=events.x.numpy().astype(integer))
    assert_same(everything(open_events(path)), events)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"p": None}, "has no array 'p'; it holds: height, t, width, x, y"),
        ({"x": np.ones(5, dtype=np.uint16)}, "of one length, but 'x' has shape"),
        ({"t": np.ones((10, 1), dtype=np.int64), "x": np.ones((10, 1), dtype=np.int64)}, "must be flat"),
        ({"t": np.linspace(0, 1, 10)}, "'t' must be integer microseconds, got float64"),
        ({"y": np.ones(10)}, "'y' must be integer numbers, got float64"),
        ({"x": np.array([object()] * 10)}, "'x' holds Python objects"),
        ({"t": np.full(10, 2**63, dtype=np.uint64)}, "t must lie within"),
        ({"width": None}, "does not say the sensor's width"),
        ({"width": np.array([64, 64])}, r"'width' must be one integer, got shape \(2,\)"),
        ({"width": np.float64(64)}, "'width' must be one integer, got .* float64"),
        ({"height": np.int64(0)}, "does not say|sensor size must be positive"),
    ],
)
def test_npz_files_that_are_refused(tmp_path, changes, message):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE), **changes)
    with pytest.raises(EventDataError, match=message):
        list(open_events(path).chunks())


def test_a_sensor_size_that_contradicts_the_file(tmp_path):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    assert open_events(path, 64, 48).width == 64
    with pytest.raises(EventDataError, match="width is 64, but 640 was given"):
        open_events(path, 640, 48)


def test_a_sensor_size_that_the_file_does_not_say(tmp_path):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE), width=None, height=None)
    assert open_events(path, 100, 50).height == 50


def test_not_a_zip(tmp_path):
    path = save_text(tmp_path / "e.npz", "hello")
    with pytest.raises(UnknownFormatError, match=r"e\.npz' is not an \.npz file"):
        NpzEvents(path)


def test_a_zip_without_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as archive:
        archive.writestr("events.txt", "0.1 1 2 1\n")
    with pytest.raises(UnknownFormatError, match="holds no numpy arrays"):
        open_events(tmp_path / "e.zip")


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.99])
def test_a_truncated_npz(tmp_path, keep):
    path = save_npz(tmp_path / "e.npz", random_events(1000, **SIZE))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(EventDataError, match=r"e\.npz' is truncated or damaged"):
        open_events(path)


@pytest.mark.parametrize("compressed", [False, True], ids=["stored", "compressed"])
def test_a_changed_byte_is_noticed(tmp_path, compressed):
    path = save_npz(tmp_path / "e.npz", random_events(2000, **SIZE), compressed)
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("p.npy")
    content[info.header_offset + 200 + info.compress_size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(EventDataError, match="truncated or damaged"):
        list(open_events(path).chunks())


def rewrite_member(path, key: str, content: bytes) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**members, f"{key}.npy": content}.items():
            archive.writestr(name, data)


def test_a_header_that_promises_too_much(tmp_path):
    """Its size is compared before memory of that size is asked for."""
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    header = b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000,), }\n"
    rewrite_member(path, "t", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(EventDataError, match=r"'t' should have shape \(1000000000000,\) of int64, but holds 0 bytes"):
        open_events(path)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\x93NUMPY\x09\x00\x00\x00", b"\x93NUMPY\x01\x00\x04\x00{}{\n"])
def test_a_header_that_cannot_be_read(tmp_path, content):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    rewrite_member(path, "t", content)
    with pytest.raises(EventDataError, match="'t' has no readable numpy header"):
        open_events(path)


@pytest.mark.parametrize("kind", ["text", "npz"])
def test_mutated_files_never_crash(tmp_path, kind):
    """Whatever a file holds, it is read, or an error of ours says why not."""
    rng = np.random.default_rng(0)
    events = random_events(60, **SIZE)
    if kind == "text":
        rows = zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), strict=True)
        path = save_text(tmp_path / "e.txt", "".join(f"0.{t:06d} {x} {y} 1\n" for t, x, y in rows))
    else:
        path = save_npz(tmp_path / "e.npz", events, compressed=True)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    read = refused = 0
    for _ in range(300):
        mutated = content.copy()
        at = rng.integers(0, len(content), size=rng.integers(1, 6))
        mutated[at] = rng.integers(0, 256, size=len(at))
        path.write_bytes(mutated.tobytes())
        try:
            everything(open_events(path, **SIZE))
            read += 1
        except (EventDataError, UnknownFormatError):
            refused += 1
    assert read + refused == 300
    assert refused > 100

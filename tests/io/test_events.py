"""Event files: opened by content, checked as they are streamed."""

import math
from fractions import Fraction

import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything, save_npz, save_text

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError, MissingFileError, UnknownFormatError
from torchtrack.io import DavisTextEvents, EventSource, NpzEvents, davis_text, open_events

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


def test_formats_that_are_not_read(data_dir):
    with pytest.raises(UnknownFormatError, match=r"Supported: .*npz.*DAVIS text"):
        open_events(data_dir / "recordings" / "planar_square_flip.mat")


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
        source = open_events(save_text(tmp_path / "e.txt", "".join(f"0.0000{t} 1 2 1\n" for t in t_us)), strict=True)
    else:
        ones = np.ones(5, dtype=np.uint16)
        source = open_events(save_npz(tmp_path / "e.npz", EventBatch.from_numpy(ones, ones, np.array(t_us), ones)), strict=True)
    with pytest.raises(EventDataError, match=r"e\.(txt|npz): time goes back from 30 to 25 µs at event 3"):
        list(source.chunks(max_events))


@pytest.mark.parametrize("kind", ["text", "npz"])
def test_events_outside_the_sensor_are_found(tmp_path, kind):
    if kind == "text":
        source = open_events(save_text(tmp_path / "e.txt", "0.1 10 10 1\n0.2 240 10 0\n"), strict=True)
    else:
        x, y = np.array([10, 240]), np.array([10, 10])
        path = save_npz(tmp_path / "e.npz", EventBatch.from_numpy(x, y, x, x > 99), width=None, height=None)
        source = open_events(path, width=240, height=180, strict=True)
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


@pytest.mark.parametrize("content", [b"% Date 2020\n\x01\x02", b"\x89HDF\r\n", b"a,b,c,d\n1,2,3,1\n", b"0.1 2 3 1\n\x00\x00"])
def test_unknown_formats_list_the_known_ones(tmp_path, content):
    (tmp_path / "events.bin").write_bytes(content)
    with pytest.raises(UnknownFormatError, match=r"events\.bin' is in no known event format .*Supported: numpy \.npz .*, DAVIS text"):
        open_events(tmp_path / "events.bin")


@pytest.mark.parametrize("size", [{"width": 240}, {"height": 180}, {"width": -1, "height": 5}])
def test_half_a_sensor_size_is_refused(tmp_path, size):
    path = save_text(tmp_path / "e.txt", "0.1 1 1 1\n")
    with pytest.raises(EventDataError, match="sensor size must be positive"):
        open_events(path, **size)

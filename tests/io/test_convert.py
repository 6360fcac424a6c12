"""Conversions are exact: the same events in the same order, to the µs."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import random_events
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from io_files import assert_same, everything
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.main import main
from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError, UnknownFormatError
from torchtrack.io import open_events, read_sequence
from torchtrack.io.convert import WRITERS, convert
from torchtrack.io.formats import Input
from torchtrack.io.writers.base import EventWriter

LIBRARIES = {"aedat4": ("dv_processing", "lz4.frame")}
SUFFIX = {"evt2": ".raw", "evt3": ".raw", "aedat4": ".aedat4", "dsec": ".h5", "npz": ".npz", "csv": ".csv"}


@pytest.fixture(params=sorted(WRITERS))
def kind(request) -> str:
    for library in LIBRARIES.get(request.param, ()):
        pytest.importorskip(library)
    return request.param


def written(folder: Path, kind: str, events: EventBatch, width: int, height: int, cut: int = 0) -> Path:
    path = folder / f"events{SUFFIX[kind]}"
    writer: EventWriter = WRITERS[kind](path, width, height)
    writer.write(events[:cut])
    writer.write(events[cut:])
    writer.close()
    return path


# Steps that stay within the low bits of each clock, pass them, and pass the wraps of EVT3 (16.8 s) and EVT2 (4.8 h).
STEPS = st.one_of(st.just(0), st.integers(0, 3), st.integers(0, 5000), st.integers(0, 40_000_000), st.integers(0, 2 * 10**10))


@st.composite
def streams(draw) -> EventBatch:
    """Runs of neighbours in a row, which become vectors, and lone events; with gaps of any length."""
    runs = draw(
        st.lists(st.tuples(STEPS, st.integers(0, 60), st.integers(0, 47), st.booleans(), st.lists(st.integers(1, 5), max_size=20)), max_size=30)
    )
    t_us = draw(st.sampled_from([0, 17, 2**24 - 3, 10**15]))
    rows = []
    for step, x, y, polarity, spacing in runs:
        t_us += step
        columns = x + np.cumsum([0, *spacing])
        rows += [(t_us, column, y, polarity) for column in columns[columns < 64].tolist()]
    t, x, y, p = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventBatch.from_numpy(x, y, t, p)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=streams(), cut=st.integers(0, 100))
def test_what_is_written_is_read(tmp_path, kind, events, cut):
    path = written(tmp_path, kind, events, 64, 48, min(cut, len(events)))
    source = open_events(path, strict=True)
    assert (source.width, source.height) == (64, 48)
    assert_same(everything(source), events)
    assert_same(everything(source, 3), events)


@pytest.mark.parametrize("t_us", [-10_001, -(10**12)])
def test_times_before_zero(tmp_path, kind, t_us):
    events = random_events(100, width=64, height=48)
    events = EventBatch(events.x, events.y, events.t_us + t_us, events.polarity, events.stream_index)
    if kind == "aedat4":
        with pytest.raises(EventDataError, match="no times before 0"):
            written(tmp_path, kind, events, 64, 48)
        return
    assert_same(everything(open_events(written(tmp_path, kind, events, 64, 48))), events)


def test_vectors_make_evt3_smaller(tmp_path):
    x = np.tile(np.arange(60), 100)
    events = EventBatch.from_numpy(x, np.repeat(np.arange(100) % 48, 60), np.repeat(np.arange(100), 60), np.ones(6000))
    path = written(tmp_path, "evt3", events, 64, 48)
    # Five vectors of 12 take 10 words, with at most 3 before them.
    assert path.stat().st_size < 100 * 2 * 13 + 300
    assert_same(everything(open_events(path)), events)


def test_another_decoder_reads_what_is_written(tmp_path):
    evt3 = pytest.importorskip("evt3")
    events = random_events(5000, width=64, height=48, duration_us=200_000)
    known = evt3.decode_file(str(written(tmp_path, "evt3", events, 64, 48)))
    assert (known.sensor_width, known.sensor_height) == (64, 48)
    for name, values in (("timestamp", events.t_us), ("x", events.x), ("y", events.y), ("polarity", events.polarity)):
        assert getattr(known, name).tolist() == values.int().tolist(), name


def test_writers_refuse_what_is_wrong(tmp_path, kind):
    writer = WRITERS[kind](tmp_path / f"e{SUFFIX[kind]}", 64, 48)
    values = np.array([1])
    writer.write(EventBatch.from_numpy(values, values, values * 100, values))
    with pytest.raises(EventDataError, match="time goes back from 100 to 99 µs at event 1"):
        writer.write(EventBatch.from_numpy(values, values, values * 99, values))
    with pytest.raises(EventDataError, match=r"event 1 is at \(64, 1\), outside the sensor of 64x48"):
        writer.write(EventBatch.from_numpy(values * 64, values, values * 100, values))
    writer.close()


@pytest.mark.parametrize(("kind", "size"), [("evt2", 2049), ("evt3", 2049), ("dsec", 70_000), ("npz", 70_000), ("aedat4", 40_000)])
def test_sensors_that_do_not_fit(tmp_path, kind, size):
    for library in LIBRARIES.get(kind, ()):
        pytest.importorskip(library)
    with pytest.raises(EventDataError, match=f"holds sensors of up to .* got {size}x1"):
        WRITERS[kind](tmp_path / f"e{SUFFIX[kind]}", size, 1)


# ---- convert


@pytest.mark.parametrize("name", ["evt3_sample.raw", "dvs_sample.es"])
def test_recordings_go_through_every_format(data_dir, tmp_path, kind, name):
    source = data_dir / "recordings" / name
    expected = everything(open_events(source))
    done = convert(source, tmp_path / f"out{SUFFIX[kind]}", kind)
    assert (done.format, done.count) == (kind, len(expected))
    assert_same(everything(open_events(tmp_path / f"out{SUFFIX[kind]}")), expected)


def test_a_sequence_stays_whole(tmp_path):
    first = write_tiny_sequence(tmp_path, labels=("box", "other"))
    assert convert(first, tmp_path / "second.h5").format == "sequence"
    assert convert(tmp_path / "second.h5", tmp_path / "third" / "tiny.npz").format == "npz"
    expected = read_sequence(first)
    for path in (tmp_path / "second.h5", tmp_path / "third" / "tiny.npz"):
        sequence = read_sequence(path)
        assert sequence.camera == expected.camera
        assert sequence.meta == expected.meta
        assert_same(everything(sequence.events), everything(expected.events))
        for obj, known in zip(sequence.objects, expected.objects, strict=True):
            assert obj.label == known.label
            assert obj.mesh_path.read_bytes() == known.mesh_path.read_bytes()
            assert torch.equal(obj.ground_truth.T_cam_obj, known.ground_truth.T_cam_obj)
            assert torch.equal(obj.ground_truth.t_us, known.ground_truth.t_us)


def test_numbers_per_event_and_further_arrays_stay(tmp_path):
    first = write_tiny_sequence(tmp_path)
    with np.load(first) as arrays:
        content = dict(arrays)
    source = np.arange(len(content["t"]), dtype=np.int16) % 3 - 2
    more = {"velocity": np.ones((1, len(content["pose_t"]), 6)), "occluder_labels": np.array(["bar", "hand"]), "source": source}
    np.savez(first, **content, **more)
    convert(first, tmp_path / "second.h5")
    convert(tmp_path / "second.h5", tmp_path / "third.npz")
    with np.load(tmp_path / "third.npz") as arrays:
        for name, expected in more.items():
            assert np.array_equal(arrays[name], expected), name


def test_a_sequence_without_its_models(tmp_path):
    convert(write_tiny_sequence(tmp_path), tmp_path / "plain.h5", "dsec")
    with pytest.raises(UnknownFormatError, match="holds events alone"):
        convert(tmp_path / "plain.h5", tmp_path / "whole.h5", "sequence")


def test_an_unknown_suffix_lists_the_known_ones(tmp_path, data_dir):
    with pytest.raises(UnknownFormatError, match=r"\.raw, \.aedat4, .*evt2, evt3"):
        convert(data_dir / "recordings" / "ncars_sample.dat", tmp_path / "out.xyz")


def test_nothing_is_left_where_a_conversion_fails(tmp_path):
    (tmp_path / "bad.txt").write_text("0.1 1 1 1\n0.2 1 2\n")
    with pytest.raises(EventDataError, match="line 2"):
        convert(Input(tmp_path / "bad.txt", strict=True), tmp_path / "out.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.txt"]


# ---- commands


def test_info_and_convert_commands(tmp_path, data_dir, capsys):
    source = str(data_dir / "recordings" / "ncars_sample.dat")
    assert main(["info", source]) == 0
    assert "Prophesee DAT" in capsys.readouterr().out
    assert main(["info", source, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["count"] == 2009
    assert main(["convert", source, str(tmp_path / "out.raw"), "--format", "evt2"]) == 0
    assert "2,009 events" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "out.raw")]) == 0
    assert "EVT2" in capsys.readouterr().out


def test_what_was_left_out_is_told(tmp_path, capsys):
    (tmp_path / "bad.txt").write_text("0.1 1 1 1\n0.2 1 2\n0.3 500 1 1\n0.4 1 1 1\n")
    assert main(["convert", str(tmp_path / "bad.txt"), str(tmp_path / "out.csv")]) == 0
    assert "left out: 1 entries that cannot be read, 1 events outside the sensor" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "bad.txt"), "--strict"]) == 1
    assert "line 2" in capsys.readouterr().err

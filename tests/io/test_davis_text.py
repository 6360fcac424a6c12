"""DAVIS text: exact times however a line is laid out, malformed lines named, constant memory."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_files import SIZE, assert_same, everything, peak_bytes, save_text

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io import davis_text, open_events

# The same examples in every run, however busy the machine is.
REPEATABLE = settings(deadline=None, derandomize=True)

digits = st.integers(0, 12).flatmap(lambda places: st.integers(0, 10**places - 1).map(lambda value: f"{value:0{places}d}" if places else ""))
seconds = st.tuples(st.integers(0, 2000), digits).map(lambda parts: f"{parts[0]}.{parts[1]}" if parts[1] else str(parts[0]))
blanks = st.sampled_from([" ", "  ", "\t", " \t "])
oddities = st.sampled_from(["", "", "", "# comment", "   ", "\r"])


@REPEATABLE
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
    with pytest.raises(EventDataError, match=rf"e\.txt: line 303: expected 't x y p' .*, got '{line}': .*{reason}"):
        list(open_events(path, strict=True).chunks())


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
        list(open_events(path, strict=True).chunks())


def test_text_is_streamed_in_constant_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(davis_text, "_BLOCK_BYTES", 1 << 14)
    peaks = []
    for count in (100_000, 300_000):
        path = save_text(tmp_path / "e.txt", "".join(f"0.{i:06d} {i % 240} {i % 180} {i % 2}\n" for i in range(count)))
        peaks.append(peak_bytes(open_events(path), 10_000))
    assert peaks[1] < 1.1 * peaks[0] and peaks[1] < 1_000_000

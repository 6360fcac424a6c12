"""RAW words: every kind, wraps, streams cut anywhere, and what cannot be known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_files import everything

from torchtrack.errors import EventDataError, TorchtrackWarning, UnknownFormatError
from torchtrack.io import open_events
from torchtrack.io.columns import Columns, join
from torchtrack.io.evt2 import Evt2Decoder
from torchtrack.io.evt3 import Evt3Decoder
from torchtrack.io.evt21 import Evt21Decoder
from torchtrack.io.mending import Mender
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.raw_file import make_decoder

ROW, EVENT, BASE, VECT12, VECT8, LOW, HIGH = (kind << 12 for kind in (0, 2, 3, 4, 5, 6, 8))
UP = 0x800


def plain(events: Columns) -> list[tuple[int, int, int, int]]:
    return list(zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), (events.polarity > 0).astype(int).tolist(), strict=True))


def evt3(*words: int, cuts: tuple[int, ...] = ()) -> tuple[list[tuple[int, int, int, int]], Problems]:
    problems = Problems("words", strict=False)
    decoder = Evt3Decoder(problems)
    parts = np.split(np.array(words, "<u2"), cuts)
    return plain(join([*(decoder.feed(part) for part in parts), decoder.finish()])), problems


def slow_evt3(words: list[int]) -> list[tuple[int, int, int, int]]:
    """The format word by word, as its description has it."""
    high = low = row = base = None
    loops, up, events = 0, 0, []

    def emit(x: int, polarity: int) -> None:
        if high is not None and row is not None:
            events.append(((loops << 24) + (high << 12) + low, x, row, polarity))

    for word in words:
        kind, value = word & 0xF000, word & 0xFFF
        if kind == ROW:
            row = value & 0x7FF
        elif kind == LOW:
            low = value
        elif kind == HIGH:
            if high is not None:
                loops += high - value >= 2048
            low = low if high == value else 0
            high = value
        elif kind == EVENT:
            emit(value & 0x7FF, value >> 11)
        elif kind == BASE:
            base, up = value & 0x7FF, value >> 11
        elif kind in (VECT12, VECT8) and base is not None:
            for bit in range(12 if kind == VECT12 else 8):
                if value >> bit & 1:
                    emit(base + bit, up)
            base += 12 if kind == VECT12 else 8
    return events


WORDS = st.builds(
    lambda kind, value: kind << 12 | value,
    st.sampled_from([0, 0, 2, 2, 2, 3, 4, 4, 5, 6, 6, 7, 8, 10, 14, 15, 1, 9]),
    st.one_of(st.integers(0, 0xFFF), st.integers(0, 20)),
)


def forward(words: list[int], longest: int) -> list[int]:
    """The same words, with times that go on by less than ``longest`` from one time high to the next."""
    high, spread = 4090, []
    for word in words:
        high += (word & 0xFFF) % longest if word & 0xF000 == HIGH else 0
        spread.append(HIGH | high % 4096 if word & 0xF000 == HIGH else word)
    return spread


@settings(max_examples=150, deadline=None)
@given(words=st.lists(WORDS, max_size=120), cut=st.integers(0, 120), longest=st.sampled_from([2, 3, 1000]))
def test_any_words_are_decoded_as_one_by_one(words, cut, longest):
    words = forward(words, longest)
    decoded, problems = evt3(*words, cuts=(min(cut, len(words)),))
    assert decoded == slow_evt3(words)
    assert problems.counts[Problem.UNKNOWN] == sum(word >> 12 in (1, 9) for word in words)


@settings(max_examples=60, deadline=None)
@given(words=st.lists(WORDS, max_size=120), cut=st.integers(0, 120))
def test_skipping_keeps_up_with_decoding(words, cut):
    words = forward(words, 3)
    decoded, skipped = (Evt3Decoder(Problems("words", strict=False)) for _ in range(2))
    first, rest = np.split(np.array(words, "<u2"), [min(cut, len(words))])
    decoded.feed(first)
    skipped.skip(first)
    assert plain(decoded.feed(rest)) == plain(skipped.feed(rest))


def test_agreement_with_another_decoder():
    """On streams as cameras send them: every time high is the next or one after it, and a time low follows."""
    evt3_library = pytest.importorskip("evt3")
    random = np.random.default_rng(0)
    words = [HIGH | 4050, LOW, ROW, BASE]
    high = 4050
    for _ in range(3000):
        kind = int(random.choice([ROW, EVENT, BASE, VECT12, VECT8, LOW, HIGH], p=[0.2, 0.3, 0.1, 0.1, 0.1, 0.15, 0.05]))
        if kind == HIGH:
            high += int(random.integers(1, 3))
            words += [HIGH | high % 4096, LOW | int(random.integers(0, 4096))]
        else:
            words.append(kind | int(random.integers(0, 4096)))
    known = evt3_library.Decoder(2048, 2048).feed(np.array(words, "<u2").tobytes())
    columns = (known.timestamp, known.x, known.y, known.polarity)
    assert evt3(*words)[0] == list(zip(*(column.tolist() for column in columns), strict=True))


def test_a_time_high_that_repeats_keeps_the_low_bits():
    assert evt3(HIGH | 5, LOW | 7, ROW | 1, EVENT | 2, HIGH | 5, EVENT | 3)[0] == [(5 * 4096 + 7, 2, 1, 0), (5 * 4096 + 7, 3, 1, 0)]


def test_the_clock_wraps_after_seventeen_seconds():
    events, _ = evt3(
        *(HIGH | 4095, LOW | 4095, ROW | 1, EVENT | 2, HIGH, LOW | 1, EVENT | 2),
        *(HIGH | 2000, LOW, EVENT | 2, HIGH | 3000, HIGH | 1, LOW, EVENT | UP | 2),
    )
    assert [t for t, *_ in events] == [2**24 - 1, 2**24 + 1, 2**24 + 2000 * 4096, 2**25 + 4096]


def test_a_stream_that_starts_in_the_middle_leaves_out_what_nobody_knows():
    events, problems = evt3(EVENT | 1, ROW | 3, EVENT | 2, VECT8 | 0xFF, HIGH | 1, VECT8 | 3, EVENT | 5, LOW | 9, BASE | 10, VECT8 | 1)
    assert events == [(4096, 5, 3, 0), (4105, 10, 3, 0)]
    assert problems.counts == {Problem.HEADLESS: 12}


def test_vectors_without_end_do_not_come_back():
    events, _ = evt3(HIGH, LOW, ROW, BASE, *[VECT12 | 0xFFF] * 20_000, cuts=(5_000, 12_000))
    assert min(x for _, x, *_ in events[2048:]) >= 2048


def word2(kind: int, t: int, x: int, y: int) -> int:
    return kind << 28 | t << 22 | x << 11 | y


def test_evt2_words():
    problems = Problems("words", strict=False)
    decoder = Evt2Decoder(problems)
    words = [word2(1, 3, 9, 9), 8 << 28 | 2, word2(1, 5, 10, 20), 10 << 28, word2(0, 6, 2047, 0), 8 << 28 | (2**28 - 1), word2(1, 63, 1, 2), 8 << 28]
    first = decoder.feed(np.array(words, "<u4"))
    second = decoder.feed(np.array([word2(0, 1, 3, 4), 5 << 28], "<u4"))
    assert plain(first) == [(133, 10, 20, 1), (134, 2047, 0, 0), (2**34 - 1, 1, 2, 1)]
    assert plain(second) == [(2**34 + 1, 3, 4, 0)]
    assert problems.counts == {Problem.HEADLESS: 1, Problem.UNKNOWN: 1}


@pytest.mark.parametrize("legacy", [False, True])
def test_evt21_words(tmp_path, legacy):
    words = [8 << 60 | 3 << 32, 1 << 60 | 7 << 54 | 32 << 43 | 11 << 32 | 0x80000001, 10 << 60, 0 << 60 | 8 << 54 | 64 << 43 | 12 << 32 | 0b110]
    expected = [(199, 32, 11, 1), (199, 63, 11, 1), (200, 65, 12, 0), (200, 66, 12, 0)]
    sent = np.array([(word >> 32 | word << 32) & (2**64 - 1) if legacy else word for word in words], "<u8")
    decoder = Evt21Decoder(Problems("words", strict=True), legacy)
    assert plain(join([decoder.feed(sent[:1]), decoder.feed(sent[1:])])) == expected
    for name, header in (("said", f"% format EVT21;endianness={'legacy' if legacy else 'little'};height=320;width=320"), ("seen", "% evt 2.1")):
        path = tmp_path / f"{name}.raw"
        path.write_bytes(f"{header}\n% end\n".encode() + sent.tobytes())
        assert plain(Columns.from_batch(everything(open_events(path, strict=True)))) == expected


# ---- files


def raw_file(folder, words: list[int], header: str = "% evt 3.0\n% geometry 64x48\n% end\n", rest: bytes = b""):
    path = folder / "e.raw"
    path.write_bytes(header.encode() + np.array(words, "<u2").tobytes() + rest)
    return path


GOOD = [HIGH, LOW | 5, ROW | 1, EVENT | 2, LOW | 9, EVENT | 3, EVENT | 4]


@pytest.mark.parametrize(
    ("words", "rest", "problem", "reason"),
    [
        ([*GOOD, 1 << 12], b"", Problem.UNKNOWN, r"1 words are of no kind of this encoding \(first: 1\)"),
        (GOOD, b"\0", Problem.DAMAGED, "ends within a word: 1 bytes are left over"),
        ([*GOOD, EVENT | 64], b"", Problem.OUTSIDE, r"event 3 is at \(64, 1\), outside the sensor of 64x48 pixels \(1 such events\)"),
    ],
)
def test_what_is_wrong_is_an_error_or_left_out(tmp_path, words, rest, problem, reason):
    path = raw_file(tmp_path, words, rest=rest)
    with pytest.raises(EventDataError, match=reason):
        everything(open_events(path, strict=True))
    source = open_events(path)
    with pytest.warns(TorchtrackWarning, match=f"some of it was left out. First of 1 {problem.value}: .*{reason}"):
        events = everything(source)
    assert events.t_us.tolist() == [5, 9, 9]
    assert source.problems.counts == {problem: 1}
    with pytest.warns(TorchtrackWarning):
        assert source.info().problems == {problem.value: 1}


@pytest.mark.parametrize(
    ("header", "size"),
    [
        ("% evt 3.0\n% geometry 320x200\n", (320, 200)),
        ("% format EVT3;height=100;width=300\n% end\n", (300, 100)),
        ("% evt 3.0\n% plugin_name hal_plugin_gen31_fx3\n", (640, 480)),
        ("% evt 3.0\n% plugin_name hal_plugin_imx636\n", (1280, 720)),
        ("% evt 3.0\n% sensor_name genx320\n", (320, 320)),
        ("% evt 3.0\n", (1280, 720)),
    ],
)
def test_sensor_sizes(tmp_path, header, size):
    source = open_events(raw_file(tmp_path, [HIGH | 1, LOW, ROW, EVENT], header))
    assert (source.width, source.height) == size
    assert len(everything(source)) == 1


def test_a_size_that_disagrees_with_the_header(tmp_path):
    with pytest.raises(EventDataError, match="width is 64, but 65 was given"):
        open_events(raw_file(tmp_path, GOOD), 65, 48)


def test_encodings_that_are_not_known(tmp_path):
    with pytest.raises(UnknownFormatError, match=r"EVT2, EVT2.1 or EVT3\): unknown: 4"):
        open_events(raw_file(tmp_path, GOOD, "% evt 4\n"))


def test_a_single_wild_time_word_is_ignored(tmp_path):
    words = [HIGH, LOW | 5, ROW | 1, EVENT | 2, HIGH | 9, EVENT | 3, HIGH, LOW | 7, EVENT | 4, LOW | 8, EVENT | 5]
    source = open_events(raw_file(tmp_path, words))
    with pytest.warns(TorchtrackWarning, match="1 time words that contradict their neighbours"):
        events = everything(source)
    assert events.t_us.tolist() == [5, 5, 7, 8]


# ---- time words with a flipped bit


def steady(encoding: str) -> tuple[np.ndarray, np.ndarray]:
    """Words with an event each 8 µs over 0.2 s, and which of them are time high words."""
    t_us = np.arange(0, 200_000, 8)
    if encoding == "evt2":
        rows = [[8 << 28 | t >> 6] * (t % 64 == 0) + [word2(1, t % 64, t // 8 % 64, 3)] for t in t_us.tolist()]
        words = np.array([word for row in rows for word in row], "<u4")
        return words, words >> 28 == 8
    if encoding == "evt21":
        rows = [[8 << 60 | t >> 6 << 32] * (t % 64 == 0) + [1 << 60 | t % 64 << 54 | 32 << 43 | 3 << 32 | 1] for t in t_us.tolist()]
        words = np.array([word for row in rows for word in row], "<u8")
        return words, words >> np.uint64(60) == 8
    rows = [[HIGH | t >> 12] * (t % 64 == 0) + [LOW | t % 4096, ROW | 3, EVENT | t // 8 % 64] for t in t_us.tolist()]
    words = np.array([word for row in rows for word in row], "<u2")
    return words, words >> 12 == 8


@pytest.mark.parametrize("encoding", ["evt2", "evt21", "evt3"])
@pytest.mark.parametrize("block", [50, 1000, 100_000])
def test_a_flipped_bit_in_a_time_word_costs_no_more_than_lies_between_two_words(encoding, block):
    words, is_high = steady(encoding)
    bits = {"evt2": range(28), "evt21": range(32, 60), "evt3": range(12)}[encoding]
    for number, bit in enumerate(bits[:: 5 if block == 50 else 2]):
        broken = words.copy()
        broken[np.flatnonzero(is_high)[1500 + 7 * number]] ^= words.dtype.type(1 << bit)
        decoder = make_decoder(encoding, Problems("words", strict=False))
        parts = [decoder.feed(broken[start : start + block]) for start in range(0, len(broken), block)]
        problems = Problems("words", strict=False)
        mender = Mender(problems, waits=True)
        mended_events = join([piece for part in [*parts, decoder.finish()] for piece in mender.add(part)] + mender.rest())
        assert len(mended_events) >= 25_000 - 16
        assert np.isin(mended_events.t_us, np.arange(0, 200_000, 8)).mean() > 0.999
        assert (mended_events.t_us[-1], problems.clock_changes) == (199_992, [])

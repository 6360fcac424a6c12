"""Streams whose time is faulty go on: late events are sorted in, repeated ones dropped, clocks that wrap or jump back go on."""

import h5py
import numpy as np
import pytest
from io_files import everything, save_npz, save_text
from tiny_sequence import write_tiny_sequence

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError, TorchtrackWarning
from torchtrack.io import open_events, read_sequence
from torchtrack.io.columns import Columns, join
from torchtrack.io.mending import Mender, mended_batches
from torchtrack.io.problems import Problem, Problems

COUNT, SPAN_US, MIDDLE = 20_000, 200_000, 10_000


def stream() -> Columns:
    """Events over 0.2 s, about one each 10 µs."""
    random = np.random.default_rng(0)
    t_us = np.sort(random.integers(0, SPAN_US, COUNT))
    x, y, p = random.integers(0, 64, COUNT), random.integers(0, 48, COUNT), random.integers(0, 2, COUNT)
    return Columns(t_us, x.astype(np.uint16), y.astype(np.uint16), p.astype(bool))


def at(t_us: np.ndarray) -> Columns:
    """The stream with other times."""
    return Columns(t_us, *(getattr(stream(), name) for name in ("x", "y", "polarity")))


def mended(events: Columns, part: int, waits: bool = True, strict: bool = False) -> tuple[Columns, Problems]:
    problems = Problems("made", strict)
    mender = Mender(problems, waits=waits)
    pieces = [piece for start in range(0, len(events), part) for piece in mender.add(events[start : start + part])]
    return join([*pieces, *mender.rest()]), problems


def packets(span_us: int) -> list[np.ndarray]:
    """Numbers of the events in each packet of so long."""
    return np.split(np.arange(COUNT), np.flatnonzero(np.diff(stream().t_us // span_us)) + 1)


def late_packets() -> Columns:
    """Packets of 1 ms, of which every seventh comes after the four after it."""
    order = [(number + 4.5 if number % 7 == 0 else number, packet) for number, packet in enumerate(packets(1000))]
    return stream()[np.concatenate([packet for _, packet in sorted(order, key=lambda pair: pair[0])])]


def moved(by_us: int) -> np.ndarray:
    """Times of which the second half is moved."""
    return stream().t_us + np.where(np.arange(COUNT) >= MIDDLE, by_us, 0)


parts = pytest.mark.parametrize("part", [COUNT, 1500, 97])


@parts
@pytest.mark.parametrize("waits", [False, True])
def test_what_is_in_order_passes_through_untouched(part, waits):
    events = stream()
    mender = Mender(Problems("made", strict=True), waits=waits)
    given = [events[start : start + part] for start in range(0, COUNT, part)]
    pieces = [piece for packet in given for piece in mender.add(packet)] + mender.rest()
    assert len(pieces) == len(given)
    assert all(piece is packet for piece, packet in zip(pieces, given, strict=True))


@parts
def test_late_packets_are_sorted_in(part):
    mended_events, problems = mended(late_packets(), part)
    assert mended_events.t_us.tolist() == stream().t_us.tolist()
    assert mended_events.x.sum() == stream().x.sum()
    assert set(problems.counts) == {Problem.SORTED}


def test_a_live_stream_waits_once_packets_came_late():
    mended_events, problems = mended(late_packets(), 100, waits=False)
    assert problems.counts[Problem.BACK] == COUNT - len(mended_events) < len(packets(1000)[0]) + 1
    assert (np.diff(mended_events.t_us) >= 0).all()


@parts
@pytest.mark.parametrize(("span_us", "waits"), [(1000, True), (1000, False), (20_000, True)])
def test_packets_that_are_sent_twice_count_once(part, span_us, waits):
    order = [np.tile(packet, 2) if number % 3 == 0 else packet for number, packet in enumerate(packets(span_us))]
    twice = stream()[np.concatenate(order)]
    mended_events, problems = mended(twice, part, waits)
    # Of those at the very time where a packet ends, one or another stays.
    assert COUNT <= len(mended_events) <= COUNT + 10
    assert problems.counts == {Problem.REPEATED: len(twice) - len(mended_events)}


@parts
@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("back_us", [30_000, 100_000, 1_000_000_000])
def test_after_a_jump_back_time_goes_on(part, waits, back_us):
    mended_events, problems = mended(at(moved(-back_us)), part, waits)
    assert len(mended_events) == COUNT
    assert np.abs(mended_events.t_us - stream().t_us).max() < 50
    assert problems.counts == {Problem.RESET: 1}
    (change,) = problems.clock_changes
    before = int(stream().t_us[MIDDLE - 1])
    assert (change.kind, change.at_us, change.from_us) == ("reset", before + 1, before)
    assert change.to_us == moved(-back_us)[MIDDLE]


@parts
@pytest.mark.parametrize(
    ("dtype", "bits", "begins"), [(np.uint32, 32, 2**32 - 100_000), (np.int32, 32, 2**31 - 100_000), (np.int64, 31, 2**31 - 100_000)]
)
def test_counters_that_begin_again_are_unwrapped(part, dtype, bits, begins):
    shown = (stream().t_us + begins) % 2**bits
    shown = shown.astype(np.uint32).view(np.int32) if dtype == np.int32 else shown.astype(dtype)
    mended_events, problems = mended(at(shown), part)
    assert mended_events.t_us.tolist() == (stream().t_us + begins).tolist()
    assert problems.counts == {Problem.WRAPPED: 1}
    assert problems.clock_changes[0].kind == "wrap"


@parts
@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("ahead_us", [300_000, 3_000_000_000, 10**15])
def test_wild_times_cost_their_events(part, waits, ahead_us):
    t_us = stream().t_us.copy()
    t_us[::1999] += ahead_us
    mended_events, problems = mended(at(t_us), part, waits)
    kept = np.arange(COUNT) % 1999 > 0
    assert mended_events.t_us.tolist() == stream().t_us[kept].tolist()
    assert problems.counts == {Problem.WILD: COUNT - kept.sum()}


@parts
@pytest.mark.parametrize("ahead_us", [300_000, 3_000_000_000, 10**15])
def test_a_wild_time_in_a_packet_that_comes_late_costs_its_event(part, ahead_us):
    numbers = packets(1000)
    order = np.concatenate([*numbers[:10], *numbers[11:14], numbers[10], *numbers[14:]])
    t_us, wild = stream().t_us.copy(), numbers[10][len(numbers[10]) // 2]
    t_us[wild] += ahead_us
    mended_events, problems = mended(at(t_us)[order], part)
    assert mended_events.t_us.tolist() == np.delete(stream().t_us, wild).tolist()
    assert problems.counts == {Problem.WILD: 1, Problem.SORTED: len(numbers[10]) - 1}


def test_a_leap_forward_that_lasts_is_a_gap():
    mended_events, problems = mended(at(moved(3_600_000_000)), 1000)
    assert mended_events.t_us.tolist() == moved(3_600_000_000).tolist()
    assert not problems.counts


def test_what_comes_far_too_late_is_left_out():
    numbers = packets(5000)
    order = np.concatenate([*numbers[:10], *numbers[11:20], numbers[10], *numbers[20:]])
    mended_events, problems = mended(stream()[order], 1000)
    assert len(mended_events) == COUNT - len(numbers[10])
    assert problems.counts == {Problem.BACK: len(numbers[10])}


@pytest.mark.parametrize("seed", range(3))
def test_times_in_no_order_come_to_an_end(seed):
    mended_events, problems = mended(at(np.random.default_rng(seed).permutation(stream().t_us)), 5000)
    assert (np.diff(mended_events.t_us) >= 0).all()
    assert problems.counts[Problem.BACK] > COUNT // 2


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (late_packets(), "made: time goes back from .* Sort the events by time"),
        (at(moved(-100_000)), "time goes back from .* and stays there: the clock was set back"),
        (at(((stream().t_us + 2**32 - 100_000) % 2**32).astype(np.uint32)), "a counter of 32 bits began again. Add 2.32 to the times from there on"),
        (at(np.where(np.arange(COUNT) == MIDDLE, 10**12, stream().t_us)), "what came just before is wild"),
        (stream()[np.concatenate([np.arange(3000), np.arange(2500, COUNT)])], "a packet was sent twice"),
        (stream()[np.concatenate([np.arange(6000), np.arange(3000, COUNT)])], "what comes then was there already. Send each packet once"),
    ],
)
def test_strict_reading_names_the_fault(events, message):
    with pytest.raises(EventDataError, match=message):
        mended(events, 1000, strict=True)


def test_times_near_the_ends_of_64_bits_are_refused_where_they_are_in_no_order():
    with pytest.raises(EventDataError, match="a time of 9.* µs makes no sense"):
        mended(at(stream().t_us.astype(np.uint64)[::-1] + np.uint64(2**63)), 1000)
    with pytest.raises(EventDataError, match="a time of -9.* µs makes no sense"):
        mended(at(np.where(np.arange(COUNT) < MIDDLE, stream().t_us, -(2**63))), 1000)


# ---- through the readers


def csv(path, events: Columns):
    rows = zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.polarity.astype(int).tolist(), strict=True)
    return save_text(path.with_suffix(".csv"), "# width=64 height=48\nt,x,y,p\n" + "".join(f"{t},{x},{y},{p}\n" for t, x, y, p in rows))


def npz(path, events: Columns):
    return save_npz(path.with_suffix(".npz"), events.batch(), t=events.t_us)


def hdf5(path, events: Columns):
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        for name, values in zip("txyp", (events.t_us, events.x, events.y, events.polarity), strict=True):
            file[f"events/{name}"] = values
        file.attrs["width"], file.attrs["height"] = 64, 48
    return path.with_suffix(".h5")


@pytest.mark.parametrize("write", [csv, npz, hdf5])
@pytest.mark.parametrize(
    ("events", "problem"),
    [
        (late_packets(), Problem.SORTED),
        (at(moved(-100_000)), Problem.RESET),
        (at(((stream().t_us + 2**32 - 100_000) % 2**32).astype(np.uint32)), Problem.WRAPPED),
    ],
)
def test_every_reader_mends(tmp_path, write, events, problem):
    source = open_events(write(tmp_path / "e", events))
    with pytest.warns(TorchtrackWarning, match=f"e.*: it was mended. First of .* {problem.value}"):
        mended_events = everything(source, 3000)
    assert len(mended_events) == COUNT
    assert np.abs(np.diff(mended_events.t_us.numpy()) - np.diff(stream().t_us)).max() < 50
    assert set(source.problems.counts) == {problem}


def test_batches_of_ones_own_are_mended():
    events = at(moved(-100_000))
    batches = [events[start : start + 100].batch() for start in range(0, COUNT, 100)]
    problems = Problems("the stream", strict=False)
    with pytest.warns(TorchtrackWarning, match="the stream: it was mended"):
        mended_events = concatenate(mended_batches(batches, 64, 48, problems))
    assert len(mended_events) == COUNT
    assert problems.counts == {Problem.RESET: 1}


def test_batches_outside_the_sensor_are_left_out():
    batch = EventBatch.from_numpy(np.array([1, 64]), np.array([1, 1]), np.array([5, 6]), np.ones(2))
    problems = Problems("the stream", strict=False)
    with pytest.warns(TorchtrackWarning, match="1 events outside the sensor"):
        assert len(concatenate(mended_batches([batch], 64, 48, problems))) == 1


def test_a_sequence_with_one_event_out_of_order_is_read(tmp_path):
    path = write_tiny_sequence(tmp_path)
    with np.load(path) as arrays:
        content = dict(arrays)
    content["t"] = content["t"].copy()
    content["t"][300] -= 2_000
    np.savez(path, **content)
    with pytest.warns(TorchtrackWarning, match="1 events that came late, sorted in"):
        assert len(everything(read_sequence(path).events)) == len(content["t"])
    with pytest.raises(EventDataError, match="Sort the events by time"):
        everything(read_sequence(path, strict=True).events)

"""What files do not say, or say in the words of other tools: units, polarity, streams, and the layout of text."""

import warnings

import h5py
import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything, save_npz

from torchtrack.config.events import ReadingConfig
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError, TorchtrackWarning
from torchtrack.io import open_events
from torchtrack.io.polarity_code import with_one_polarity_reported

EVENTS = random_events(3000, **SIZE)
T, X, Y = (values.numpy() for values in (EVENTS.t_us, EVENTS.x, EVENTS.y))
P = EVENTS.polarity.numpy().astype(np.int64)
UNITS = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}


def opened(path, strict=True, **choices):
    return open_events(path, **SIZE, strict=strict, choices=ReadingConfig(**choices))


def save_h5(path, group="events", **arrays):
    with h5py.File(path, "a") as file:
        for name, values in ({"t": T, "x": X, "y": Y, "p": P} | arrays).items():
            if values is not None:
                file[f"{group}/{name}"] = values
    return path


def save_lines(path, line, head="", encoding="utf-8"):
    path.write_bytes((head + "".join(line(*row) for row in zip(T.tolist(), X.tolist(), Y.tolist(), P.tolist(), strict=True))).encode(encoding))
    return path


def of_kind(tmp_path, kind, numbers):
    """A file of the same events whose times are ``numbers``."""
    if kind == "npz":
        return save_npz(tmp_path / "e.npz", EVENTS, t=numbers)
    if kind == "hdf5":
        return save_h5(tmp_path / "e.h5", t=numbers)
    separator, suffix = (",", "csv") if kind == "csv" else (" ", "txt")
    rows = zip(numbers.tolist(), X.tolist(), Y.tolist(), P.tolist(), strict=True)
    path = tmp_path / f"e.{suffix}"
    path.write_text("".join(separator.join(map(str, row)) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("kind", ["csv", "txt", "hdf5"])
def test_floats_of_microseconds_are_refused_and_read_when_told(tmp_path, kind):
    path = of_kind(tmp_path, kind, T.astype(float))
    with pytest.raises(EventDataError, match=r"e\.\w+'?: times .*cannot be seconds.* µs would fit.*events\.time_unit \(--time-unit\) to us"):
        opened(path)
    assert_same(everything(opened(path, time_unit="us")), EVENTS)


@pytest.mark.parametrize("kind", ["csv", "txt", "hdf5", "npz"])
@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_that_is_told_is_taken(tmp_path, kind, unit):
    path = of_kind(tmp_path, kind, T / UNITS[unit])
    assert_same(everything(opened(path, time_unit=unit)), EVENTS)


@pytest.mark.parametrize("kind", ["csv", "hdf5", "npz"])
def test_whole_nanoseconds_of_unix_time_are_refused_and_read_when_told(tmp_path, kind):
    start_us = 1_700_000_000_000_000
    path = of_kind(tmp_path, kind, (T + start_us) * 1000)
    with pytest.raises(EventDataError, match=r"cannot be µs: that would be \d\d,\d+ years\. ns would fit"):
        opened(path)
    assert everything(opened(path, time_unit="ns")).t_us.tolist() == (T + start_us).tolist()


@pytest.mark.parametrize("kind", ["csv", "hdf5", "npz"])
def test_whole_nanoseconds_from_zero_are_told(tmp_path, kind):
    # 3,000 events in 10 ms.
    path = of_kind(tmp_path, kind, np.sort(np.random.default_rng(0).integers(0, 10_000, 3000)) * 1000)
    with pytest.warns(TorchtrackWarning, match="read as µs, but that would be .* ns would fit"):
        opened(path)


def test_numbers_with_decimals_need_a_unit_in_npz(tmp_path):
    with pytest.raises(EventDataError, match=r"'t' must be integer microseconds, got float64\. If it has another unit, set events\.time_unit"):
        opened(save_npz(tmp_path / "e.npz", EVENTS, t=T / 1e6))


def test_units_that_files_say_are_taken(tmp_path):
    assert_same(everything(opened(save_npz(tmp_path / "e.npz", EVENTS, t=None, t_ns=T * 1000))), EVENTS)
    assert_same(everything(opened(save_h5(tmp_path / "name.h5", t=None, timestamp_ms=T / 1e3))), EVENTS)
    path = save_h5(tmp_path / "attribute.h5", t=T * 1000)
    with h5py.File(path, "a") as file:
        file["events/t"].attrs["unit"] = "ns"
    assert_same(everything(opened(path)), EVENTS)
    for name in ("t_ns", "time [ns]", "Timestamp(ns)", '"TIMESTAMP_NS"'):
        assert_same(everything(opened(save_lines(tmp_path / "e.csv", lambda t, x, y, p: f"{t * 1000},{x},{y},{p}\n", f"{name},x,y,p\n"))), EVENTS)


def test_formats_that_say_the_unit_take_no_other(data_dir):
    with pytest.raises(EventDataError, match=r"events.time_unit is 'ns', but this format has the unit of its times\. Leave it out"):
        open_events(data_dir / "recordings" / "ncars_sample.dat", choices=ReadingConfig(time_unit="ns"))
    with pytest.raises(EventDataError, match="events.topic is 'left', but this format has a single stream"):
        open_events(data_dir / "recordings" / "ncars_sample.dat", choices=ReadingConfig(topic="left"))


@pytest.mark.parametrize(
    ("codes", "brighter", "message"),
    [
        (np.where(P > 0, 1, 255).astype(np.uint8), 1, "polarity holds 1 and 255; expected 0 and 1, or -1 and 1.*probably 1"),
        ((P + 1).astype(np.uint8), 2, "polarity holds 1 and 2;.*probably 2"),
        (np.arange(3000) % 4, 3, "polarity holds 0, 1, 2 and 3;"),
        (np.arange(3000) % 3 - 1, 1, "polarity holds -1, 0 and 1;"),
        (np.arange(3000) % 100, 7, "polarity holds 0, 1, 2, 3, 4, 5, …;"),
    ],
)
@pytest.mark.parametrize("kind", ["npz", "hdf5", "csv", "txt"])
def test_codes_of_polarity_that_are_not_known_are_refused_and_read_when_told(tmp_path, kind, codes, brighter, message):
    if kind == "npz":
        path = save_npz(tmp_path / "e.npz", EVENTS, p=codes)
    elif kind == "hdf5":
        path = save_h5(tmp_path / "e.h5", p=codes)
    else:
        path = tmp_path / f"e.{kind}"
        separator = {"csv": ",", "txt": " "}[kind]
        seconds = [f"{t / 1e6:.6f}" for t in T.tolist()]
        path.write_text("".join(separator.join(map(str, row)) + "\n" for row in zip(seconds, X.tolist(), Y.tolist(), codes.tolist(), strict=True)))
    with pytest.raises(EventDataError, match=message):
        everything(opened(path, strict=False))
    read = everything(opened(path, polarity=brighter))
    assert read.t_us.tolist() == T.tolist()
    assert read.polarity.tolist() == (codes == brighter).tolist()


@pytest.mark.parametrize("codes", [P, 2 * P - 1, P.astype(bool), P.astype(np.float32)])
def test_codes_of_polarity_that_are_known(tmp_path, codes):
    path = save_npz(tmp_path / "e.npz", EVENTS, p=codes)
    assert_same(everything(opened(path)), EVENTS)
    assert everything(opened(path, polarity="inverted")).polarity.tolist() == (~EVENTS.polarity).tolist()


def test_single_wrong_polarities_are_damage(tmp_path):
    codes = P.copy()
    codes[[5, 77]] = 9
    path = save_npz(tmp_path / "e.npz", EVENTS, p=codes)
    with pytest.warns(TorchtrackWarning, match="First of 2 entries that cannot be read: polarity holds 9 in 2 events"):
        assert len(everything(opened(path, strict=False))) == 2998
    with pytest.raises(EventDataError, match="polarity holds 9 in 2 events"):
        everything(opened(path))


@pytest.mark.parametrize(("code", "which"), [(1, "brighter"), (0, "darker")])
def test_events_of_one_polarity_are_told(tmp_path, code, which):
    source = opened(save_npz(tmp_path / "e.npz", EVENTS, p=np.full(3000, code)))
    with pytest.warns(TorchtrackWarning, match=f"'e': all of its first 3000 events got {which}"):
        assert sum(map(len, with_one_polarity_reported(source.chunks(), "'e'"))) == 3000
    with pytest.warns(TorchtrackWarning, match="all of its first 10000 events"):
        next(with_one_polarity_reported(iter([concatenate([next(source.chunks())] * 4)[:10_000]]), "'e'"))


def test_one_of_several_streams_is_told_and_chosen(tmp_path):
    left = {f"left_{name}": values for name, values in zip("txyp", (T, X, Y, P), strict=True)}
    right = {f"right_{name}": values for name, values in zip("txyp", (T + 7, X, Y, P), strict=True)}
    path = tmp_path / "e.npz"
    np.savez(path, **left, **right)
    with pytest.warns(TorchtrackWarning, match="of its 2 streams of events, 'left' is read; the others are 'right'. Choose one with events.topic"):
        assert everything(opened(path)).t_us[0] == T[0]
    assert everything(opened(path, topic="right")).t_us[0] == T[0] + 7
    with pytest.raises(EventDataError, match="there are no events named 'middle'; its streams of events are: left, right"):
        opened(path, topic="middle")


def test_one_of_several_groups_is_told_and_chosen(tmp_path):
    path = save_h5(save_h5(tmp_path / "e.h5", "prophesee/right", t=T + 7), "prophesee/left")
    with pytest.warns(TorchtrackWarning, match="'prophesee/left' is read; the others are 'prophesee/right'"):
        assert everything(opened(path)).t_us[0] == T[0]
    source = opened(path, topic="prophesee/right")
    assert source.streams == ("prophesee/left", "prophesee/right")
    assert everything(source).t_us[0] == T[0] + 7


NAMED = [
    ("t;x;y;p\n", lambda t, x, y, p: f"{t};{x};{y};{p}\n", "utf-8"),
    ("t\tx\ty\tp\r\n", lambda t, x, y, p: f"{t}\t{x}\t{y}\t{p}\r\n", "utf-8"),
    ("x y p t_us\n", lambda t, x, y, p: f"{x} {y} {p} {t}\n", "utf-8"),
    ("# X, Y, Polarity, Timestamp\n", lambda t, x, y, p: f"{x}, {y}, {p}, {t}\n", "utf-8-sig"),
    ("// made by a tool\n% t x y p\n", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}\n", "utf-8"),
    (",t,x,y,p,weight\n", lambda t, x, y, p: f"{x},{t},{x},{y},{p},0.5\n", "utf-8"),
    ("time (s);x;y;polarity\n", lambda t, x, y, p: f"{t / 1e6:.6f};{x};{y};{p}\n".replace(".", ","), "utf-8"),
    ("t,x,y,p\n", lambda t, x, y, p: f"{t},{x}.0,{y}.0,{bool(p)}\n", "utf-8"),
    ("t,x,y,p\r\n", lambda t, x, y, p: f"{t},{x},{y},{p}\r\n", "utf-16"),
    ("", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}\n", "utf-16"),
    ("", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}\n", "utf-8-sig"),
    ("64 48\n", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}\n", "utf-8"),
]


@pytest.mark.parametrize(("head", "line", "encoding"), NAMED)
def test_text_as_tools_write_it(tmp_path, head, line, encoding):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(everything(opened(save_lines(tmp_path / "e.txt", line, head, encoding))), EVENTS)


def test_columns_in_an_order_that_is_no_custom_are_told(tmp_path):
    path = save_lines(tmp_path / "e.csv", lambda t, x, y, p: f"{x},{y},{t},{p}\n")
    with pytest.warns(TorchtrackWarning, match="columns are taken as x, y, t, p: only one never decreases"):
        source = opened(path)
    assert_same(everything(source), EVENTS)


@pytest.mark.parametrize(
    ("head", "line", "message"),
    [
        ("t,x,y,p\n", "0,000310,12,34,1\n", "line 2 has 5 columns, but 4 are named: t, x, y, p. Where commas separate columns, decimals need points"),
        ("", "1,2,3,1,7\n", "line 1 has 5 columns and no names. Expected four, or a first line that names t, x, y and p"),
        ("t,x,y,weight\n", "1,2,3,1\n", "its columns are named t, x, y, weight; which of them is p is not said"),
    ],
)
def test_text_whose_columns_cannot_be_told_is_refused(tmp_path, head, line, message):
    path = tmp_path / "e.csv"
    path.write_text(head + 30 * line)
    with pytest.raises(EventDataError, match=message):
        opened(path)


def test_events_in_memory_are_checked_too():
    with pytest.raises(EventDataError, match="polarity holds 1 and 2"):
        EventBatch.from_numpy(X, Y, T, P + 1)

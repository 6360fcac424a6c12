"""Live sources: what comes is tracked or counted as dropped, and stopping leaves complete outputs."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml
from helpers import random_events
from io_files import assert_same
from tiny_sequence import CAMERA, write_tiny_sequence

from torchtrack.config.events import is_live
from torchtrack.config.run import RunConfig
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.windows import EventWindow
from torchtrack.errors import ConfigError, EventDataError, MissingExtraError
from torchtrack.io import extras, read_sequence
from torchtrack.io.keep_up import KeepUp
from torchtrack.io.live import DvSource, Evk4Source, StreamSource, open_live
from torchtrack.io.writers.evt3 import Evt3Writer
from torchtrack.run.runner import run
from torchtrack.run.session import open_session

SIZE = {"width": 64, "height": 48}


def windows(count: int):
    return [EventWindow(random_events(10, seed=i), 1000 * i, 1000 * (i + 1)) for i in range(count)]


# ---- the queue


def test_a_consumer_gets_all_of_the_stream():
    every = windows(50)
    keep_up = KeepUp(every, capacity=50)
    taken = list(keep_up.until(lambda: False))
    assert (taken[0].t_start_us, taken[-1].t_end_us) == (0, 50_000)
    assert sum(len(window.events) for window in taken) == 500
    assert len(taken) + keep_up.waiting.joined_windows == 50
    assert (keep_up.waiting.dropped_windows, keep_up.waiting.dropped_events) == (0, 0)


def test_what_does_not_fit_is_joined_and_counted():
    every = windows(50)
    all_came = threading.Event()

    def source():
        yield from every
        all_came.set()

    keep_up = KeepUp(source(), capacity=5)
    consumer = keep_up.until(lambda: False)
    taken = [next(consumer)]
    assert all_came.wait(10)
    taken += list(consumer)
    # All of the time, without a gap.
    assert [window.t_start_us for window in taken] == [0, *(window.t_end_us for window in taken[:-1])]
    assert taken[-1].t_end_us == 50_000
    assert keep_up.waiting.joined_windows == 50 - len(taken) >= 40
    assert keep_up.waiting.dropped_windows == 0


def test_an_error_of_the_source_reaches_the_consumer():
    def broken():
        yield windows(1)[0]
        raise EventDataError("the cable is out")

    consumer = KeepUp(broken(), capacity=5).until(lambda: False)
    next(consumer)
    with pytest.raises(EventDataError, match="the cable is out"):
        next(consumer)


def test_stopping_ends_the_source_too():
    stopped = threading.Event()

    def endless():
        number = 0
        while not stopped.is_set():
            yield EventWindow(EventBatch.empty(), number, number + 1)
            number += 1
            time.sleep(0.001)

    keep_up = KeepUp(endless(), 5, stopped.set)
    seen: list[EventWindow] = []
    for window in keep_up.until(lambda: len(seen) >= 3):
        seen.append(window)  # noqa: PERF402 - what was seen so far decides when to stop
    assert stopped.is_set()
    with pytest.raises(KeyboardInterrupt):
        next(KeepUp(iter(()), 5).until(lambda: True))


# ---- standard input


def piped(data: bytes) -> int:
    """A descriptor from which ``data`` can be read, in pieces that cut words."""
    reading, writing = os.pipe()

    def send():
        for start in range(0, len(data), 4097):
            os.write(writing, data[start : start + 4097])
        os.close(writing)

    threading.Thread(target=send).start()
    return reading


def test_words_from_a_pipe(tmp_path):
    events = random_events(20_000, **SIZE)
    writer = Evt3Writer(tmp_path / "e.raw", 64, 48)
    writer.write(events)
    writer.close()
    data = (tmp_path / "e.raw").read_bytes()
    source = StreamSource("pipe", piped(data))
    assert (source.width, source.height) == (64, 48)
    # Looking at the first events does not take them away.
    assert len(next(source.chunks(100))) == 100
    assert_same(concatenate(source.chunks(100)), events)
    bare = StreamSource("pipe", piped(data[data.index(b"% end\n") + 6 :]), 64, 48)
    assert_same(concatenate(bare.chunks()), events)


def test_a_stream_without_a_size(tmp_path):
    with pytest.raises(EventDataError, match="sensor size must be positive"):
        StreamSource("pipe", piped(b"\0" * 10))


# ---- faults while events come


class Unplugged:
    """A camera or a reader that gives nothing but an exception."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def getEventResolution(self):
        return 64, 48

    def getNextEventBatch(self):
        raise self.error

    def open(self, serial):
        return self

    def __iter__(self):
        return self

    def __next__(self):
        raise self.error


@pytest.mark.parametrize("error", [RuntimeError("LIBUSB_ERROR_NO_DEVICE"), OSError(19, "No such device"), ValueError("bad  transfer")])
@pytest.mark.parametrize("make", [lambda device: DvSource("davis://", device), lambda device: Evk4Source("evk4://", device, "")])
def test_a_camera_that_is_unplugged(make, error):
    source = make(Unplugged(error))
    with pytest.raises(EventDataError, match=r"'(davis|evk4)://' has failed while events were read: .*\. Check cable and power"):
        next(source.chunks())


def test_a_descriptor_that_fails():
    reading, writing = os.pipe()
    os.write(writing, b"\0" * 10)
    source = StreamSource("pipe", reading, 64, 48)
    os.close(reading)
    with pytest.raises(EventDataError, match="'pipe' has failed while events were read: .*Bad file descriptor"):
        next(source.chunks())
    with pytest.raises(EventDataError, match="'pipe' has failed"):
        StreamSource("pipe", reading, 64, 48)
    os.close(writing)


def test_a_fault_amid_the_stream_keeps_what_came_before():
    def failing():
        yield from windows(3)
        next(DvSource("davis://", Unplugged(RuntimeError("unplugged"))).chunks())

    seen = []
    with pytest.raises(EventDataError, match="unplugged"):
        for window in KeepUp(failing(), 5).until(lambda: False):
            seen.append(window)  # noqa: PERF402 - what came before the error is kept
    assert seen[-1].t_end_us == 3000


# ---- addresses


@pytest.mark.parametrize(("source", "live"), [("dv://host:1", True), ("-", True), ("stdin://", True), ("evk4://", True), ("a/b.raw", False)])
def test_addresses_are_told_from_files(source, live):
    assert is_live(source) is live
    assert isinstance(RunConfig(source=source).source, str if live else Path)


@pytest.mark.parametrize("source", ["dv://host", "dv://:7", "dv://host:seven"])
def test_addresses_that_are_wrong(source):
    pytest.importorskip("dv_processing")
    with pytest.raises(EventDataError, match=r"is no live source. Known: dv://HOST:PORT"):
        open_live(source)


@pytest.mark.parametrize(
    ("source", "library"), [("dv://localhost:1", "dv_processing"), ("evk4://", "neuromorphic_drivers"), ("davis://", "dv_processing")]
)
def test_nobody_there(source, library):
    pytest.importorskip(library)
    with pytest.raises(EventDataError, match="cannot be opened"):
        open_live(source)


def test_a_library_that_is_missing(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(extras.importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchtrack\[live\]'"):
        open_live("evk4://")


def test_a_live_source_needs_a_camera_and_no_hot_pixels():
    with pytest.raises(ConfigError, match="'-' sends events alone"):
        open_session(RunConfig(source="-"))


# ---- tracking


def live_config(folder: Path, source: str, **changes) -> dict:
    """Settings that track the tiny box from a live source."""
    sequence = read_sequence(write_tiny_sequence(folder))
    first = sequence.objects[0].ground_truth.T_cam_obj[0]
    mesh = sequence.objects[0].mesh_path
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    objects = [{"label": "box", "mesh": str(mesh), "initial_pose": {"matrix": first.tolist()}}]
    return {"source": source, "camera": camera, "objects": objects, "output": str(folder / "out"), "overlay": {"enabled": False}, **changes}


SENDER = """
import os, sys, time
import dv_processing as dv, numpy as np
port, count, rate = map(int, sys.argv[1:])
random = np.random.default_rng(0)
t = np.sort(random.integers(0, count * 1_000_000 // rate, count)) + 1
rows = list(zip(t.tolist(), random.integers(0, 120, count).tolist(), random.integers(0, 90, count).tolist(), (random.random(count) < 0.5).tolist()))
stores = []
for start in range(0, count, 10_000):
    store = dv.EventStore()
    for row in rows[start : start + 10_000]:
        store.push_back(*row)
    stores.append(store)
# An event after the end, which tells that all before it has come.
end = dv.EventStore()
end.push_back(count * 1_000_000 // rate + 10, 0, 0, True)
stores.append(end)
writer = dv.io.NetworkWriter("127.0.0.1", port, dv.io.Stream.EventStream(0, "events", "test", (120, 90)))
print("ready", flush=True)
while writer.getClientCount() == 0:
    time.sleep(0.001)
begun = time.perf_counter()
for number, store in enumerate(stores, start=1):
    writer.writeEvents(store)
    time.sleep(max(begun + number * 10_000 / rate - time.perf_counter(), 0))
sys.stdin.readline()
# The library waits for its clients when it is taken down.
os._exit(0)
"""


@pytest.fixture
def sender():
    """Starts processes that send events over TCP; returns the port, and a function that ends the sending."""
    pytest.importorskip("dv_processing")
    processes = []

    def start(count: int, rate: int) -> int:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        process = subprocess.Popen(
            [sys.executable, "-c", SENDER, str(port), str(count), str(rate)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        assert process.stdout.readline() == "ready\n"
        return port

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_two_million_events_over_tcp_are_tracked_without_loss(tmp_path, sender):
    count = 2_000_000
    port = sender(count, 5_000_000)
    # Noise has no pose: a search for one would take nearly all of the time.
    settings = {"end_us": count // 5, "events": {"live_windows": 1000}, "tracker": {"relocalization": {"hypotheses": 0}}}
    summary = run(RunConfig.model_validate(live_config(tmp_path, f"dv://127.0.0.1:{port}", **settings)))
    assert summary.dropped_windows == 0
    assert summary.events + summary.dropped_events == count
    assert summary.windows + summary.joined_windows == 80


def test_ctrl_c_leaves_complete_outputs(tmp_path):
    config = live_config(tmp_path, "stdin://")
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(config))
    events = concatenate(read_sequence(tmp_path / "tiny.npz").events.chunks())
    writer = Evt3Writer(tmp_path / "e.raw", CAMERA.width, CAMERA.height)
    writer.write(events)
    writer.close()
    command = [sys.executable, "-m", "torchtrack", "track", str(tmp_path / "live.yaml"), "--quiet"]
    command[1:3] = ["-c", "import sys; from torchtrack.cli.main import main; sys.exit(main())"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdin.write((tmp_path / "e.raw").read_bytes())
    process.stdin.flush()
    waited = time.monotonic() + 60
    poses = tmp_path / "out" / "poses.csv"
    while not (poses.exists() and len(poses.read_text().splitlines()) > 1) and time.monotonic() < waited:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130, errors.decode()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["interrupted"]
    assert summary["windows"] >= 1
    assert len((tmp_path / "out" / "trajectory_box.tum").read_text().splitlines()) >= summary["windows"]

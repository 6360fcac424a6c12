"""How fast files of events are read: streamed, checked, as batches of tensors, on one core.

Every file holds the same events: rows of neighbours that fire together, as edges make them, on an HD sensor at about
20 Mev/s. It is read once before it is measured, so that it lies in the system's cache. What counts is the processor's time:
on an idle machine that is the time that passes, and other work beside it does not count.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchtrack.bench.results import Report, Result
from torchtrack.bench.setup import Setup
from torchtrack.core.events import EventBatch
from torchtrack.errors import MissingExtraError
from torchtrack.io.convert import WRITERS
from torchtrack.io.formats import open_events

WIDTH, HEIGHT = 1280, 720
# Millions of events per second.
TARGETS = {"evt3": 30.0, "evt2": 50.0, "dat": 50.0, "dsec": 40.0, "npz": None, "aedat4": 25.0, "davis": 3.0, "csv": 3.0}
_SUFFIX = {"evt3": ".raw", "evt2": ".raw", "dat": ".dat", "dsec": ".h5", "npz": ".npz", "aedat4": ".aedat4", "davis": ".txt", "csv": ".csv"}
_BATCH = 500_000
_TEXT_SHARE = 10


def measure(setup: Setup) -> Report:
    """Reading speed per format (Mev/s); text holds a tenth of the events, and formats whose libraries are missing are left out."""
    results, notes = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name, target in TARGETS.items():
            setup.show(name)
            count = max(setup.events // _TEXT_SHARE, 1) if name in ("davis", "csv") else setup.events
            path = Path(folder) / f"events{_SUFFIX[name]}"
            try:
                write_events(path, name, count)
                figures = [_speed(path, count) for _ in range(setup.repeats + 1)][1:]
            except MissingExtraError as error:
                notes.append(f"{name}: left out: {error}")
                continue
            results.append(Result(name, "Mev/s", tuple(figures), target))
            path.unlink()
    return Report("io", "Reading events, one core", tuple(results), tuple(notes))


def synthetic(events: int, seed: int = 0) -> Iterator[EventBatch]:
    """Edges that move over an HD sensor: runs of up to eight neighbours in a row at one time, in batches."""
    random = np.random.default_rng(seed)
    t_us = 0
    for start in range(0, events, _BATCH):
        count = min(_BATCH, events - start)
        sizes = random.integers(1, 9, count)
        sizes = sizes[: int(np.searchsorted(np.cumsum(sizes), count)) + 1]
        run = np.repeat(np.arange(len(sizes)), sizes)[:count]
        within = np.arange(count) - (np.cumsum(sizes) - sizes)[run]
        times = t_us + np.sort(random.integers(0, max(count // 20, 1), len(sizes)))
        columns, rows = random.integers(0, WIDTH - 8, len(sizes)), random.integers(0, HEIGHT, len(sizes))
        polarity = random.integers(0, 2, len(sizes))
        t_us = int(times[-1])
        yield EventBatch.from_numpy(columns[run] + within, rows[run], times[run], polarity[run])


def write_events(path: Path, name: str, events: int) -> None:
    """Write a file of synthetic events in one of the formats of :data:`TARGETS`.

    Raises:
        MissingExtraError: if the format needs a library that is not installed.
    """
    if name in ("dat", "davis"):
        _write_plain(path, name, events)
        return
    writer = WRITERS[name](path, WIDTH, HEIGHT)
    for batch in synthetic(events):
        writer.write(batch)
    writer.close()


def _write_plain(path: Path, name: str, events: int) -> None:
    """DAT and DAVIS text, which are written for measurements alone."""
    with path.open("wb") as stream:
        if name == "dat":
            stream.write(f"% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n".encode("ascii") + b"\x0c\x08")
        for batch in synthetic(events):
            t_us, x, y, p = (values.numpy().astype(np.int64) for values in (batch.t_us, batch.x, batch.y, batch.polarity))
            if name == "dat":
                stream.write((t_us | (x | y << 14 | p << 28) << 32).astype("<u8").tobytes())
                continue
            rows = zip(t_us.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True)
            stream.write("".join(f"{t // 1_000_000}.{t % 1_000_000:06d} {u} {v} {q}\n" for t, u, v, q in rows).encode("ascii"))


def _speed(path: Path, events: int) -> float:
    """Millions of events per second of one core, in one pass."""
    size = (WIDTH, HEIGHT) if path.suffix == ".txt" else (None, None)
    begun = time.process_time()
    count = sum(len(chunk) for chunk in open_events(path, *size).chunks())
    seconds = time.process_time() - begun
    if count != events:
        raise RuntimeError(f"{path.name}: {count} events were read, {events} were written.")
    return 1e-6 * count / seconds

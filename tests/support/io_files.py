"""Event files for tests, and what to ask of their readers."""

import tracemalloc

import numpy as np
import torch

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.io import EventSource

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


def peak_bytes(source: EventSource, max_events: int) -> int:
    tracemalloc.start()
    try:
        count = sum(len(chunk) for chunk in source.chunks(max_events))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count >= 100_000
    return peak

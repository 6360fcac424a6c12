"""Events as other libraries give them become the same batch."""

import dv_processing
import evt3
import numpy as np
import pytest
import torch

from torchtrack.core.events import EventBatch, as_batch
from torchtrack.errors import EventDataError

T, X, Y, P = np.array([5, 7, 7, 900]), np.array([3, 1, 639, 0]), np.array([0, 479, 2, 4]), np.array([1, 0, 0, 1])
# Fields and types as these libraries document them.
LIBRARIES = {
    "faery": [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")],
    "metavision": np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8], "itemsize": 16}),
    "dv": np.dtype({"names": ["timestamp", "x", "y", "polarity"], "formats": ["<i8", "<i2", "<i2", "i1"], "offsets": [0, 8, 10, 12], "itemsize": 16}),
    "tonic": [("x", "<i8"), ("y", "<i8"), ("t", "<i8"), ("p", "<i8")],
    "more fields": [("camera", "u1"), ("ts", "<i8"), ("x", "<u2"), ("y", "<u2"), ("pol", "i1"), ("trigger", "?")],
}


def array_of(dtype) -> np.ndarray:
    events = np.zeros(4, dtype)
    for name in events.dtype.names:
        events[name] = {"t": T, "x": X, "y": Y, "p": P, "o": P}.get(name[0] if name != "trigger" else "", 0)
    return events


def assert_as_expected(batch: EventBatch) -> None:
    assert (batch.t_us.tolist(), batch.x.tolist(), batch.y.tolist()) == (T.tolist(), X.tolist(), Y.tolist())
    assert batch.polarity.tolist() == [True, False, False, True]
    assert (batch.t_us.dtype, batch.x.dtype, batch.polarity.dtype) == (torch.int64, torch.int32, torch.bool)


@pytest.mark.parametrize("name", LIBRARIES)
def test_structured_arrays_of_libraries(name):
    assert_as_expected(as_batch(array_of(np.dtype(LIBRARIES[name]))))


def test_objects_of_libraries():
    store = dv_processing.EventStore()
    for t, x, y, p in zip(T, X, Y, P, strict=True):
        store.push_back(int(t), int(x), int(y), bool(p))
    assert_as_expected(as_batch(store))
    arrays = {"x": X.astype(np.uint16), "y": Y.astype(np.uint16), "p": P.astype(np.uint8), "t": T.astype(np.uint64)}
    assert_as_expected(as_batch(evt3.Events.from_arrays(**arrays, geometry=(640, 480))))
    assert_as_expected(as_batch(arrays))


def test_a_batch_stays_what_it_is_and_streams_are_numbered():
    batch = EventBatch.from_numpy(X, Y, T, P)
    assert as_batch(batch) is batch
    assert EventBatch.from_library({"t": T, "x": X, "y": Y, "p": P}, stream=2).stream_index.tolist() == [2, 2, 2, 2]


@pytest.mark.parametrize(("name", "factor"), [("t_ns", 1000), ("t_us", 1), ("timestamp [ns]", 1000)])
def test_names_may_say_the_unit(name, factor):
    assert_as_expected(as_batch({name: T * factor, "x": X, "y": Y, "p": P}))


def test_seconds_by_name_are_rounded_and_without_one_refused():
    assert_as_expected(as_batch({"t_s": T * 1e-6, "x": X, "y": Y, "p": P}))
    assert as_batch({"t_ms": np.array([2]), "x": X[:1], "y": Y[:1], "p": P[:1]}).t_us.tolist() == [2000]
    with pytest.raises(EventDataError, match="t must be integers, got float64"):
        as_batch({"t": T * 1e-6, "x": X, "y": Y, "p": P})


def test_what_is_no_array_of_events_is_refused():
    with pytest.raises(EventDataError, match="the events have the fields t, x, pol; y missing"):
        as_batch({"t": T, "x": X, "pol": P})
    with pytest.raises(EventDataError, match="'p' and 'polarity' of the events both mean p"):
        as_batch({"t": T, "x": X, "y": Y, "p": P, "polarity": P})
    with pytest.raises(EventDataError, match=r"got an array of int64 of shape \[4, 4\]"):
        as_batch(np.stack([T, X, Y, P], 1))
    with pytest.raises(EventDataError, match="got list"):
        as_batch([(1, 2, 3, 1)])
    with pytest.raises(EventDataError, match="polarity holds 0, 1 and 2"):
        as_batch({"t": T, "x": X, "y": Y, "p": P * 2 + [0, 1, 0, 0]})

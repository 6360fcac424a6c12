"""Events: the flat ragged batch, its checks, and the windows a stream is cut into.

Conventions, stated once: times are integer microseconds (int64) at every boundary; windows are half open on the left,
``t_start_us < t <= t_end_us``, so an event at a window's end belongs to it; polarity is ``True`` where it got brighter.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.polarity import brighter
from torchtrack.core.structured_events import fields_of
from torchtrack.errors import EventDataError

ForeignEvents: TypeAlias = Any
"""Events of another library, in one of the forms of :mod:`torchtrack.core.structured_events`."""


@dataclass(frozen=True, repr=False)
class EventBatch:
    """Events of one or more streams in flat ragged form, sorted by time within each stream.

    Args:
        x, y: sensor pixels, int32.
        t_us: times in microseconds, int64.
        polarity: bool, ``True`` where the pixel got brighter.
        stream_index: which stream each event belongs to, int64, not decreasing; those past the last stream are of none.
        most_of_one: no stream has more of the events than this; noted by :meth:`to` on the way to a GPU, where counting them
            would take a wait.
    """

    x: Int[Tensor, "e"]
    y: Int[Tensor, "e"]
    t_us: Int[Tensor, "e"]
    polarity: Bool[Tensor, "e"]
    stream_index: Int[Tensor, "e"]
    most_of_one: int | None = field(default=None, kw_only=True)

    @classmethod
    def from_numpy(cls, x: np.ndarray, y: np.ndarray, t_us: np.ndarray, polarity: np.ndarray, stream: int = 0) -> "EventBatch":
        """A batch of one stream from arrays of any integer type; polarity is boolean, 0 or 1, or -1 or 1.

        Raises:
            EventDataError: if lengths differ, an array is not of integers, a number does not fit, or polarity is coded in another way.
        """
        lengths = {len(x), len(y), len(t_us), len(polarity)}
        if len(lengths) != 1:
            raise EventDataError(f"x, y, t and polarity must have one length, got {len(x)}, {len(y)}, {len(t_us)} and {len(polarity)}.")
        return cls(
            _integer_tensor(x, np.int32, "x"),
            _integer_tensor(y, np.int32, "y"),
            _integer_tensor(t_us, np.int64, "t"),
            torch.from_numpy(np.require(brighter(np.asarray(polarity)), requirements="W")),
            torch.full((len(x),), stream, dtype=torch.int64),
        )

    @classmethod
    def from_library(cls, events: Any, stream: int = 0) -> "EventBatch":
        """A batch of one stream from events as faery, dv-processing, evt3, Metavision and others give them.

        Times are whole microseconds, unless the name of their field says another unit, such as ``t_ns``.

        Args:
            events: a structured array ``[e]`` or another form, see :mod:`torchtrack.core.structured_events`.
            stream: which stream they are of.

        Raises:
            EventDataError: if a field is missing, or as :meth:`from_numpy`.
        """
        fields = fields_of(events)
        return cls.from_numpy(fields.x, fields.y, fields.t_us, fields.polarity, stream)

    @classmethod
    def empty(cls) -> "EventBatch":
        """A batch without events."""
        none = np.zeros(0, dtype=np.int64)
        return cls.from_numpy(none, none, none, none)

    def __len__(self) -> int:
        return len(self.t_us)

    def __repr__(self) -> str:
        if len(self) == 0:
            return "EventBatch(no events)"
        streams = len(self.stream_index.unique())
        of_streams = f" of {streams} streams" if streams > 1 else ""
        return f"EventBatch({len(self)} events{of_streams}, {int(self.t_us.min())} to {int(self.t_us.max())} µs, {self.t_us.device})"

    def __getitem__(self, index: slice | Tensor) -> "EventBatch":
        fields = (self.x, self.y, self.t_us, self.polarity, self.stream_index)
        if isinstance(index, slice):
            return EventBatch(*(values[index] for values in fields), most_of_one=self.most_of_one)
        # Which entries a mask means is found once, and they are selected several times faster than by indexing.
        chosen = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        return EventBatch(*(values.index_select(0, chosen) for values in fields), most_of_one=self.most_of_one)

    def to(self, device: torch.device | str) -> "EventBatch":
        """The same events on another device."""
        fields, to_gpu, most = (self.x, self.y, self.t_us, self.polarity, self.stream_index), torch.device(device).type != "cpu", self.most_of_one
        if most is None and to_gpu and host_sync.read_at_once(self.stream_index):
            most = _events_of_fullest(self.stream_index)
        # On the way to a GPU, values are read before this returns, but without a wait for all that is queued there.
        return EventBatch(*(values.to(device, non_blocking=to_gpu) for values in fields), most_of_one=most)

    def of_stream(self, stream: int) -> "EventBatch":
        """The same events, all said to be of one stream."""
        return replace(self, stream_index=torch.full_like(self.stream_index, stream), most_of_one=None)

    def slice_time(self, t_start_us: int, t_end_us: int) -> "EventBatch":
        """Events with ``t_start_us < t <= t_end_us``, of a batch of one stream."""
        bounds = torch.tensor([t_start_us, t_end_us], dtype=torch.int64, device=self.t_us.device)
        first, last = torch.searchsorted(self.t_us, bounds, right=True).tolist()
        return self[first:last]


def _events_of_fullest(stream_index: Int[Tensor, "e"]) -> int:
    """How many events the stream with the most of them has."""
    if len(stream_index) == 0 or int(stream_index[0]) == int(stream_index[-1]):
        return len(stream_index)
    return int(stream_index.unique_consecutive(return_counts=True)[1].max())


def _integer_tensor(values: np.ndarray, dtype: type[np.signedinteger], name: str) -> Tensor:
    """A tensor of ``dtype`` with exactly these values."""
    values = np.asarray(values)
    if values.size and values.dtype.kind not in "iu":
        raise EventDataError(f"{name} must be integers, got {values.dtype}. Times are in microseconds; multiply seconds by 1e6 and round.")
    limits = np.iinfo(dtype)
    if not np.can_cast(values.dtype, dtype) and values.size and (values.min() < limits.min or values.max() > limits.max):
        raise EventDataError(f"{name} must lie within {limits.min}…{limits.max}, got {values.min()}…{values.max()}. Check the file.")
    # torch wants memory that it may write to; arrays over a file's bytes are read-only.
    return torch.from_numpy(np.require(values, dtype=dtype, requirements=("C", "W")))


def as_batch(events: EventBatch | ForeignEvents) -> EventBatch:
    """Events as a batch: as they are, or of another library (:meth:`EventBatch.from_library`).

    Raises:
        EventDataError: if they are neither.
    """
    return events if isinstance(events, EventBatch) else EventBatch.from_library(events)


def concatenate(batches: Iterable[EventBatch]) -> EventBatch:
    """Batches one after the other; the caller keeps the order by stream, then time."""
    batches = list(batches)
    if not batches:
        return EventBatch.empty()
    return EventBatch(*(torch.cat([getattr(b, name) for b in batches]) for name in ("x", "y", "t_us", "polarity", "stream_index")))


def check_events(events: EventBatch, width: int, height: int, source: str = "events", last_t_us: int | None = None, first_index: int = 0) -> None:
    """Raise :class:`EventDataError` unless the events of one stream are sorted by time and inside the sensor.

    ``last_t_us`` is the time of the event before the first one, where there is one; ``first_index`` is the number of
    the first one in its stream, for the message.
    """
    if len(events) == 0:
        return
    steps = torch.diff(events.t_us)
    if last_t_us is not None and int(events.t_us[0]) < last_t_us:
        raise EventDataError(
            f"{source}: time goes back from {last_t_us} to {int(events.t_us[0])} µs at event {first_index}. Sort the events by time."
        )
    if bool((steps < 0).any()):
        at = int(torch.nonzero(steps < 0)[0])
        before, after = events.t_us[at : at + 2].tolist()
        raise EventDataError(f"{source}: time goes back from {before} to {after} µs at event {first_index + at + 1}. Sort the events by time.")
    check_on_sensor(events, width, height, source, first_index)


def check_on_sensor(events: EventBatch, width: int, height: int, source: str = "events", first_index: int = 0) -> None:
    """Raise :class:`EventDataError` unless the events are inside the sensor; of several, inside the largest."""
    if len(events) == 0:
        return
    (least_x, most_x), (least_y, most_y) = (torch.aminmax(values) for values in (events.x, events.y))
    if int(least_x) >= 0 and int(most_x) < width and int(least_y) >= 0 and int(most_y) < height:
        return
    outside = (events.x < 0) | (events.x >= width) | (events.y < 0) | (events.y >= height)
    at = int(torch.nonzero(outside)[0])
    raise EventDataError(
        f"{source}: event {first_index + at} is at ({int(events.x[at])}, {int(events.y[at])}), outside the sensor of {width}x{height} pixels "
        f"({int(outside.sum())} such events). Check the sensor size, or whether x and y are swapped."
    )


@dataclass(frozen=True)
class PaddedEvents:
    """The events of one window, a row per stream, padded.

    Args:
        x, y: sensor pixels; 0 for padding.
        age_us: time from the event to the window's end (µs).
        polarity: whether it got brighter.
        mask: which entries are events.
    """

    x: Int[Tensor, "s e"]
    y: Int[Tensor, "s e"]
    age_us: Int[Tensor, "s e"]
    polarity: Bool[Tensor, "s e"]
    mask: Bool[Tensor, "s e"]


def check_streams_in_order(stream_index: Int[Tensor, "e"]) -> None:
    """Raise :class:`EventDataError` unless the streams come one after the other."""
    back = stream_index[1:] < stream_index[:-1]
    if bool(back.any()):
        at = int(back.nonzero()[0])
        before, after = stream_index[at : at + 2].tolist()
        raise EventDataError(
            f"events of several streams must come one stream after the other, but after one of stream {before} there is one of stream {after} "
            f"(event {at + 1}). Sort them by stream, then time, or join the batches of the streams with torchtrack.core.events.concatenate."
        )


def of_streams(events: EventBatch, streams: int) -> EventBatch:
    """The events without those of no stream, after them."""
    if len(events) == 0 or int(events.stream_index[-1]) < streams:
        return events
    return events[: int(torch.searchsorted(events.stream_index, streams))]


def stream_bounds(events: EventBatch, streams: int) -> Int[Tensor, "_"]:
    """Where each of the ``streams`` begins among the events, and where the last one ends."""
    return torch.searchsorted(events.stream_index, constant(tuple(range(streams + 1)), torch.int64, events.stream_index.device))


def pad_streams(events: EventBatch, streams: int, t_end_us: Int[Tensor, "s"]) -> PaddedEvents:
    """Ragged events as one padded row per stream, with ages at ``t_end_us``.

    Raises:
        EventDataError: if the streams are mixed up. It is not looked for on a GPU, which would have to be waited for.
    """
    if streams == 1 and len(events):
        # Nothing to pad: the events are the row. Those of no stream, after it, are padding already.
        mask = (events.stream_index < streams)[None]
        return PaddedEvents(events.x.long()[None], events.y.long()[None], t_end_us[:, None] - events.t_us, events.polarity[None], mask)
    if streams > 1 and host_sync.read_at_once(events.stream_index):
        check_streams_in_order(events.stream_index)
    bounds = stream_bounds(events, streams)
    counts = torch.diff(bounds)
    column = torch.arange(max(_most_of_one(events, counts), 1), device=bounds.device)
    mask = column < counts[:, None]
    index = torch.where(mask, bounds[:-1, None] + column, 0)
    if len(events) == 0:
        nothing = torch.zeros_like(index)
        return PaddedEvents(nothing, nothing, nothing, mask, mask)
    age_us = torch.where(mask, t_end_us[:, None] - events.t_us[index], 0)
    x, y = (torch.where(mask, field[index], 0).long() for field in (events.x, events.y))
    return PaddedEvents(x, y, age_us, events.polarity[index] & mask, mask)


def _most_of_one(events: EventBatch, counts: Int[Tensor, "s"]) -> int:
    """Places that the fullest stream needs; on a GPU what is known of it without a wait, where anything is."""
    if len(events) == 0:
        return 0
    if events.most_of_one is None or host_sync.read_at_once(counts):
        return int(counts.max())
    return min(events.most_of_one, len(events))

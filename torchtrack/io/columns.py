"""Events as plain numpy arrays: what decoders give, before it is checked and becomes an :class:`EventBatch`."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError


@dataclass(frozen=True)
class Columns:
    """Events of one stream, in the order of the file.

    Args:
        t_us: times in microseconds, int64.
        x, y: sensor pixels, of any integer type.
        polarity: whether it got brighter: bool, or numbers that count as brighter where they are > 0.
    """

    t_us: np.ndarray
    x: np.ndarray
    y: np.ndarray
    polarity: np.ndarray

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, index: slice | np.ndarray) -> "Columns":
        return Columns(self.t_us[index], self.x[index], self.y[index], self.polarity[index])

    @classmethod
    def empty(cls) -> "Columns":
        """No events."""
        pixels = np.zeros(0, np.uint16)
        return cls(np.zeros(0, np.int64), pixels, pixels, np.zeros(0, bool))

    @classmethod
    def from_batch(cls, events: EventBatch) -> "Columns":
        """The events of a batch of one stream."""
        return cls(events.t_us.numpy(), events.x.numpy(), events.y.numpy(), events.polarity.numpy())

    def batch(self) -> EventBatch:
        """The same events as tensors.

        Raises:
            EventDataError: if they are not integers, or do not fit.
        """
        return EventBatch.from_numpy(self.x, self.y, self.t_us, self.polarity)


def shifted(t_us: np.ndarray, by_us: int) -> np.ndarray:
    """Times moved by ``by_us``.

    Raises:
        EventDataError: if some would not fit 64 bits.
    """
    if by_us == 0 or len(t_us) == 0:
        return t_us
    limits = np.iinfo(np.int64)
    if int(t_us.min()) + by_us < limits.min or int(t_us.max()) + by_us > limits.max:
        raise EventDataError(f"times that are counted from {by_us} µs on do not fit 64 bits. The file is damaged, or says the wrong offset.")
    return t_us + by_us


def join(parts: Iterable[Columns]) -> Columns:
    """Events one after the other."""
    parts = list(parts)
    if not parts:
        return Columns.empty()
    if len(parts) == 1:
        return parts[0]
    return Columns(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_us", "x", "y", "polarity")))


def parted(pieces: list[Columns], t_us: int) -> tuple[list[Columns], list[Columns]]:
    """Sorted pieces before ``t_us``, and from then on."""
    number = next((number for number, piece in enumerate(pieces) if piece.t_us[-1] >= t_us), len(pieces))
    if number == len(pieces):
        return pieces, []
    cut = int(np.searchsorted(pieces[number].t_us, t_us))
    before = [*pieces[:number], pieces[number][:cut]] if cut else pieces[:number]
    return before, [pieces[number][cut:], *pieces[number + 1 :]]


def batches_of(pieces: Iterable[Columns], max_events: int) -> Iterator[EventBatch]:
    """Events of all pieces, as batches of up to ``max_events``."""
    starts = chain.from_iterable(((piece, start) for start in range(0, len(piece), max_events)) for piece in pieces)
    return (piece[start : start + max_events].batch() for piece, start in starts)

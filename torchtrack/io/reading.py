"""How far a pass over a file of events has come, for whoever shows it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from torchtrack.io.columns import Columns

Progress = Callable[[float], None]
"""Called with the share of the work that is done, 0 to 1."""


@runtime_checkable
class Positioned(Protocol):
    """A stream of bytes that knows where it is."""

    @property
    def closed(self) -> bool:
        """Whether nothing more is read from it."""
        ...

    def tell(self) -> int:
        """How many bytes are before the next one."""
        ...


@dataclass
class Reading:
    """The newest pass over a file.

    Attributes:
        total: how many events there are: known to the reader, or as many as there will be if what is left has as many for each byte.
        position: share of the file that was read, 0 to 1, where the reader says so; or
        stream: the bytes that are read, of which there are ``size_bytes``.
        read: events that were read; those that may still be sorted among later ones are held back of them.
        count: events that were given on.
        first_us, last_us: times of the first and the last of these; None before any.
    """

    total: int | None = None
    position: float | None = None
    stream: Positioned | None = field(default=None, repr=False)
    size_bytes: int = 0
    read: int = 0
    count: int = 0
    first_us: int | None = None
    last_us: int | None = None

    def begin(self) -> None:
        """A new pass begins."""
        self.total, self.position, self.stream = None, None, None
        self.read, self.count, self.first_us, self.last_us = 0, 0, None, None

    def advance(self, count: int) -> None:
        """Note that so many more events were read."""
        self.read += count
        if self.stream is not None and self.size_bytes:
            self.position = 1.0 if self.stream.closed else self.stream.tell() / self.size_bytes
        if self.position:
            self.total = round(self.read / self.position)

    def add(self, events: Columns) -> None:
        """Note events that are given on."""
        if len(events) == 0:
            return
        self.count += len(events)
        self.first_us = int(events.t_us[0]) if self.first_us is None else self.first_us
        self.last_us = int(events.t_us[-1])

    def end(self) -> None:
        """All was read."""
        self.total = self.count

    @property
    def share(self) -> float | None:
        """How much of the file was given on, 0 to 1; None where that is not known."""
        return min(self.count / self.total, 1.0) if self.total else None

    @property
    def expected_end_us(self) -> int | None:
        """Where the stream will end, if what is left of it has as many events a second; None where that is not known yet."""
        if not self.share or self.first_us is None or self.last_us is None:
            return None
        return self.first_us + round((self.last_us - self.first_us) / self.share)

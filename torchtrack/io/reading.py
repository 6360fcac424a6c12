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
        share: of the file that was read, 0 to 1; None where it is not known. A reader sets it, or gives what it goes by:
        total: how many events there are; or
        stream: the bytes that are read, of which there are ``size_bytes``.
        count: events so far.
        first_us, last_us: times of the first and the last of them; None before any.
    """

    share: float | None = None
    total: int | None = None
    stream: Positioned | None = field(default=None, repr=False)
    size_bytes: int = 0
    count: int = 0
    first_us: int | None = None
    last_us: int | None = None

    def begin(self) -> None:
        """A new pass begins."""
        self.share, self.total, self.stream = None, None, None
        self.count, self.first_us, self.last_us = 0, None, None

    def add(self, events: Columns) -> None:
        """Note events that were read."""
        if len(events) == 0:
            return
        self.count += len(events)
        self.first_us = int(events.t_us[0]) if self.first_us is None else self.first_us
        self.last_us = int(events.t_us[-1])
        if self.total:
            self.share = min(self.count / self.total, 1.0)
        elif self.stream is not None and self.size_bytes:
            self.share = 1.0 if self.stream.closed else min(self.stream.tell() / self.size_bytes, 1.0)

    def end(self) -> None:
        """All was read."""
        self.share = 1.0

    @property
    def expected_end_us(self) -> int | None:
        """Where the stream will end, if what is left of the file has as many bytes a second; None where that is not known yet."""
        if not self.share or self.first_us is None or self.last_us is None:
            return None
        return self.first_us + round((self.last_us - self.first_us) / self.share)

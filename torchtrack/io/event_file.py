"""The base of all readers of event files: checks, faults, and where to start."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, ClassVar

from torchtrack.config.events import ReadingConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.files import check_is_file, naming
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns, batches_of
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, check_max_events, check_sensor_size
from torchtrack.io.event_stream import EventStream
from torchtrack.io.mending import Mender
from torchtrack.io.polarity_code import PolarityCode
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.reading import Reading
from torchtrack.io.soundness import inside

DEFAULT_CHOICES = ReadingConfig()


@dataclass(frozen=True)
class EventFile(EventStream):
    """Events of one file; a reader says how to open it and how to read its events.

    Args:
        path: the file.
        width, height: sensor size in pixels; 0 where the file says it, or the format has a default.
        strict: whether faults are errors; otherwise what can be read is read, and the rest is counted in
            :attr:`problems` and reported by a warning at the end.
        start_us: events before this time are passed over; where the clock changes, it is the time after mending.
        choices: how what the file does not say is read: unit of times, code of polarity, which of several streams.

    Attributes:
        reading: how far the newest pass has come.

    Raises:
        MissingFileError: if there is no such file.
        EventDataError: if it is damaged so that nothing can be read, the sensor size is unknown or disagrees, or something is
            chosen that the format leaves no choice of.
    """

    # Of a format: whether files do not say the unit of times for sure, and whether they can hold several streams.
    unit_is_open: ClassVar[bool] = False
    has_streams: ClassVar[bool] = False

    path: Path
    width: int = 0
    height: int = 0
    strict: bool = False
    start_us: int | None = None
    choices: ReadingConfig = DEFAULT_CHOICES
    streams: tuple[str, ...] = field(init=False, default=(), compare=False)
    problems: Problems = field(init=False, repr=False, compare=False)
    reading: Reading = field(init=False, repr=False, compare=False, default_factory=Reading)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        if not self.path.is_dir():
            check_is_file(self.path, "event file")
        object.__setattr__(self, "problems", Problems(str(self.path), self.strict))
        self._check_choices()
        with naming(self.path):
            self._open()
        check_sensor_size(self.width, self.height, str(self.path))

    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events in time order; see :class:`torchtrack.io.event_source.EventSource`.

        Faults of this pass are counted in :attr:`problems`.
        """
        check_max_events(max_events)
        return self._checked(max_events)

    def seek(self, t_us: int) -> "EventFile":
        """The same file from the first event with ``t >= t_us`` on."""
        return replace(self, start_us=t_us)

    @property
    def known_count(self) -> int | None:
        """How many events there are, where the file tells that without being read; an estimate where it is compressed."""
        return None

    @property
    def counter_bits(self) -> int | None:
        """Of how many bits the counter of µs is, where the format says that it begins again."""
        return None

    @abstractmethod
    def _open(self) -> None:
        """Read the header, and set what it says."""

    @abstractmethod
    def _read(self, max_events: int) -> Iterator[Columns]:
        """The events as they are in the file, in parts of about ``max_events``; it may leave out those before ``start_us``."""

    @contextmanager
    def _bytes(self) -> Iterator[BinaryIO]:
        """The file, opened for a pass over its bytes."""
        with self.path.open("rb") as stream:
            self.reading.stream, self.reading.size_bytes = stream, self.path.stat().st_size
            yield stream

    def _checked(self, max_events: int) -> Iterator[EventBatch]:
        self.problems.clear()
        self.reading.begin()
        mender, count = Mender(self.problems, waits=True, counter_bits=self.counter_bits), 0
        with naming(self.path):
            for part in self._with_polarity(self._readable(max_events)):
                events = inside(part, self.width, self.height, self.problems, count)
                count += len(part)
                self.reading.advance(len(part))
                yield from batches_of(self._noted(mender.add(events)), max_events)
            yield from batches_of(self._noted(mender.rest()), max_events)
        self.reading.end()
        self.problems.warn()

    def _noted(self, pieces: Iterable[Columns]) -> list[Columns]:
        """What was read last from the start on, in which the pass has come so far."""
        noted = list(map(self._started, pieces))
        for piece in noted:
            self.reading.add(piece)
        return noted

    def _readable(self, max_events: int) -> Iterator[Columns]:
        """What can be read: where it breaks off, the rest counts as damaged."""
        try:
            with naming(self.path):
                yield from self._read(max_events)
        except EventDataError as error:
            if self.strict:
                raise
            self.problems.record(Problem.DAMAGED, 1, str(error))

    def _with_polarity(self, parts: Iterator[Columns]) -> Iterator[Columns]:
        """The same events, with booleans for the codes of polarity that the file has."""
        code = PolarityCode(self.choices.polarity, self.problems)
        yield from map(code.applied, parts)

    def _check_choices(self) -> None:
        """Raise :class:`EventDataError` where the user chooses what the format says itself."""
        for name, has_choice in (("time_unit", self.unit_is_open), ("topic", self.has_streams)):
            given = getattr(self.choices, name)
            if given is not None and not has_choice:
                says = "the unit of its times" if name == "time_unit" else "a single stream of events"
                raise EventDataError(f"'{self.path}': events.{name} is '{given}', but this format has {says}. Leave it out.")

    def _started(self, events: Columns) -> Columns:
        if self.start_us is None or len(events) == 0 or events.t_us.min() >= self.start_us:
            return events
        return events[events.t_us >= self.start_us]

    def _settle_size(self, width: int | None, height: int | None, default: tuple[int, int] | None = None) -> None:
        """Set the sensor size from what the file says, what was given, or a default.

        Raises:
            EventDataError: if the file and what was given disagree, or nobody says it.
        """
        for index, (name, stored) in enumerate((("width", width), ("height", height))):
            given = getattr(self, name)
            if given and stored and given != stored:
                raise EventDataError(f"'{self.path}' says that the sensor's {name} is {stored}, but {given} was given. Leave it out, or correct it.")
            value = stored or given or (default[index] if default and not (self.width and self.height) else 0)
            if not value:
                raise EventDataError(f"'{self.path}' does not say the sensor's {name}. Give width and height in pixels.")
            object.__setattr__(self, name, value)

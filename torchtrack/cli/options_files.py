"""The commands about files of events: their options, as the command line types them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from torchtrack.bench.parts import Part
from torchtrack.cli.console import starting
from torchtrack.cli.option import option
from torchtrack.config.events import ReadingConfig, TimeUnit
from torchtrack.config.formats import OutputFormat
from torchtrack.errors import ConfigError

_TimeUnit = Annotated[TimeUnit | None, option("UNIT")]
_Text = Annotated[str | None, option("NAME")]
_Polarity = Annotated[str, arg(metavar="CODE")]
_Size = Annotated[int | None, option("N")]


@dataclass(frozen=True)
class Info:
    """Say what is in a file of events: format, sensor, times, rates, gaps, and what is wrong with it."""

    file: Positional[Annotated[str, arg(metavar="FILE")]]
    """A file of events, or the folder of a ROS 2 recording."""
    width: _Size = None
    """Sensor width (px), where the file does not say it."""
    height: _Size = None
    """Sensor height (px), where the file does not say it."""
    max_events: _Size = None
    """Read so many events and no more."""
    time_unit: _TimeUnit = None
    """Unit of the times, where the file does not say it: s, ms, us or ns."""
    polarity: _Polarity = "auto"
    """Which events got brighter: auto (0/1, -1/1), inverted, or the value that means brighter."""
    topic: _Text = None
    """Of a file with several streams of events, the one to read."""
    strict: bool = False
    """What is wrong is an error."""
    json: bool = False
    """Print JSON."""
    picture: Annotated[str | None, option("FILE", "-o")] = None
    """Also draw some events, with a ruler in pixels, into this file (.png)."""
    at_us: Annotated[int | None, option("N")] = None
    """Of the picture: its time, in stream time (µs); by default the start."""
    calibration: Annotated[str | None, option("FILE")] = None
    """Of the picture: take the distortion of this camera out; what is straight must look straight then."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.files import EventPicture, info
            from torchtrack.io.formats import Input

        refuse_settings(overrides)
        if self.picture is None and (self.at_us is not None or self.calibration is not None):
            raise ConfigError("command line: --at-us and --calibration are of the picture: name its file with --picture.")
        choices = _choices(self.time_unit, self.polarity, self.topic)
        calibration = None if self.calibration is None else Path(self.calibration)
        picture = None if self.picture is None else EventPicture(Path(self.picture), self.at_us, calibration)
        file = Input(Path(self.file), self.width, self.height, self.strict, choices)
        return info(file, self.max_events, picture, as_json=self.json, quiet=self.quiet)


@dataclass(frozen=True)
class Convert:
    """Write the events of a file in another format, exactly: the same events in the same order, to the µs."""

    source: Positional[Annotated[str, arg(metavar="IN")]]
    """The file to read; its format is told by its content."""
    target: Positional[Annotated[str, arg(metavar="OUT")]]
    """The file to write: .raw (EVT3), .aedat4, .h5, .npz or .csv."""
    format: Annotated[OutputFormat | None, option("NAME")] = None
    """Its format: evt2, evt3, aedat4, dsec, npz, csv or sequence; by default as its suffix says."""
    width: _Size = None
    """Sensor width (px), where the file does not say it."""
    height: _Size = None
    """Sensor height (px), where the file does not say it."""
    time_unit: _TimeUnit = None
    """Unit of the times, where the file does not say it: s, ms, us or ns."""
    polarity: _Polarity = "auto"
    """Which events got brighter: auto (0/1, -1/1), inverted, or the value that means brighter."""
    topic: _Text = None
    """Of a file with several streams of events, the one to read."""
    strict: bool = False
    """What is wrong is an error."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.files import convert_file
            from torchtrack.io.formats import Input

        refuse_settings(overrides)
        choices = _choices(self.time_unit, self.polarity, self.topic)
        return convert_file(Input(Path(self.source), self.width, self.height, self.strict, choices), self.target, self.format, quiet=self.quiet)


@dataclass(frozen=True)
class Bench:
    """Measure the speed of a part; write JSON, Markdown and plots, with medians, quartiles and targets."""

    part: Positional[Literal[Part, "all"]]
    """pipeline: a step of the tracker. presets: by others than default. stages: what it is made of. solver, surface, flow: these alone.
    lost: with an object lost. graphs: where one fails. scaling: with objects and streams. peers: other libraries beside ours. io: reading events.
    sim: rendering and making events. all: those whose libraries are installed."""
    output: Annotated[str, arg(aliases=["-o"], metavar="DIR")]
    """Folder for the results."""
    repeats: Annotated[int, arg(metavar="N")] = 7
    """How often everything is measured."""
    compare: Annotated[str | None, option("OLD.json")] = None
    """Earlier results of the same part, or the folder with them: tells how many times faster each figure is now."""
    device: Annotated[str, arg(metavar="NAME")] = "cpu"
    """Where to measure: cpu, cuda or cuda:N; io and sim are always on the CPU."""
    threads: Annotated[int, arg(metavar="N")] = 1
    """Threads of PyTorch on the CPU."""
    events: Annotated[int, arg(metavar="N")] = 5_000_000
    """Of io: events of each file."""
    sequence: Annotated[str | None, option("FILE")] = None
    """Of pipeline and stages: a sequence (.npz), in place of simulated scenes."""
    compiled: bool = False
    """Of pipeline: one object, on a GPU many too, also by compiled graphs; compiling takes some minutes."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        from torchtrack.bench.setup import Setup
        from torchtrack.cli.bench import bench, bench_device

        refuse_settings(overrides)
        sequence, compare = (Path(text) if text is not None else None for text in (self.sequence, self.compare))
        setup = Setup(self.repeats, bench_device(self.device), self.threads, self.events, sequence, self.compiled)
        return bench(self.part, Path(self.output), compare, setup)


def _choices(time_unit: TimeUnit | None, polarity: str, topic: str | None) -> ReadingConfig:
    """What the options say of how a file is read."""
    try:
        code: Any = int(polarity)
    except ValueError:
        code = polarity
    if code not in ("auto", "inverted") and not isinstance(code, int):
        raise ConfigError(f"command line: --polarity is auto, inverted or a whole number, got '{polarity}'.")
    return ReadingConfig(time_unit=time_unit, polarity=code, topic=topic)


def refuse_settings(overrides: dict[str, Any]) -> None:
    """Raise :class:`ConfigError` where settings other than limits are given to a command that has none."""
    if others := [key for key in overrides if not key.startswith("limits.")]:
        raise ConfigError(f"command line: this command takes no settings but --limits.NAME, got --{', --'.join(others)}.")

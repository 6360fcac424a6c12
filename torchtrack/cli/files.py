"""What the commands about files of events do: facts about a file, and conversion."""

import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.table import Table

from torchtrack.cli.console import OutputConsole, output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.picture import check_picture, write_picture
from torchtrack.cli.progress import progress_shown, share_of
from torchtrack.config.formats import OutputFormat
from torchtrack.core.atomic import check_other_file
from torchtrack.core.camera import undistortion_table
from torchtrack.core.events import concatenate
from torchtrack.core.windows import clipped
from torchtrack.errors import EventDataError, TorchtrackWarning
from torchtrack.io.calibration import read_calibration
from torchtrack.io.convert import convert
from torchtrack.io.event_file import EventFile
from torchtrack.io.formats import FORMAT_NAMES, Input
from torchtrack.io.info import EventInfo, as_plain
from torchtrack.io.raw_file import RawFile
from torchtrack.viz.event_picture import SHOWN_US, draw_events, soonest_event

_ONE_POLARITY = " (all alike: polarity may be coded in another way, --polarity)"


@dataclass(frozen=True)
class EventPicture:
    """A picture of some events.

    Args:
        path: the file to write.
        at_us: time that is shown; None for the start.
        calibration: of the camera whose distortion is taken out; None to leave it in.
    """

    path: Path
    at_us: int | None = None
    calibration: Path | None = None


def info(file: Input, max_events: int | None, picture: EventPicture | None = None, *, as_json: bool, quiet: bool = False) -> int:
    """Show facts about a file of events, and draw some of them; returns the exit code."""
    if picture is not None:
        check_other_file(file.path, picture.path)
        check_picture(picture.path)
    source = file.open()
    with warnings.catch_warnings(), progress_shown(quiet=quiet, kernels=False) as progress:
        # What is wrong is part of the facts.
        warnings.simplefilter("ignore", TorchtrackWarning)
        facts = source.info(max_events, share_of(progress, f"reading {file.path.name}"))
    if picture is not None:
        _write_events(source, facts, picture)
    if as_json:
        # Plain text: a console would break lines and colour them.
        OutputConsole(soft_wrap=True, highlight=False, markup=False).print(json.dumps({"format": format_name(source), **as_plain(facts)}, indent=2))
        return ExitCode.DONE
    table = Table(show_header=False, box=None)
    for row in _rows(source, facts):
        table.add_row(*row)
    console = output_console()
    console.print(table)
    if picture is not None:
        console.print(f"events are shown in {picture.path}", markup=False)
    return ExitCode.DONE


def _write_events(source: EventFile, facts: EventInfo, picture: EventPicture) -> None:
    """Draw the events after a time.

    Raises:
        EventDataError: if there are none.
        CalibrationError: if the calibration is of another sensor.
    """
    if facts.first_us is None:
        raise EventDataError(f"'{source.path}': there are no events to draw.")
    at_us = facts.first_us - 1 if picture.at_us is None else picture.at_us
    events = concatenate(list(clipped(source.chunks(), at_us, at_us + SHOWN_US)))
    if len(events) == 0:
        there = f"there are events from {facts.first_us:,} to {facts.last_us:,} µs"
        raise EventDataError(f"'{source.path}': no events within {SHOWN_US / 1000:g} ms after {at_us:,} µs; {there}.")
    pixels = torch.stack([events.x, events.y], 1)
    if picture.calibration is not None:
        camera = read_calibration(picture.calibration, facts.width, facts.height)
        pixels = undistortion_table(camera)[events.y.long(), events.x.long()]
    surface = soonest_event(pixels.round().long().numpy(), events.t_us.numpy(), at_us, (facts.width, facts.height))
    write_picture(picture.path, draw_events(surface, at_us))


def format_name(source: EventFile) -> str:
    """What a person calls the format of a file."""
    name = FORMAT_NAMES[type(source)]
    return f"{name} ({source.encoding.upper()})" if isinstance(source, RawFile) else name


def _rows(source: EventFile, facts: EventInfo) -> list[tuple[str, str]]:
    rows = [("format", format_name(source)), ("sensor", f"{facts.width}x{facts.height}")]
    if len(source.streams) > 1:
        rows.append(("streams", f"{', '.join(source.streams)} (--topic chooses)"))
    count = "unknown" if facts.count is None else f"{facts.count:,}"
    rows.append(("events", count if facts.complete else f"about {count} (not all were read)"))
    if facts.first_us is None or facts.last_us is None:
        return [*rows, *_faults(facts)]
    longest = "; ".join(f"{gap.duration_us / 1000:,.1f} ms at {gap.start_us:,} µs" for gap in facts.gaps)
    return [
        *rows,
        ("time", f"{facts.first_us:,} … {facts.last_us:,} µs"),
        ("duration", f"{1e-6 * facts.duration_us:.6f} s"),
        ("rate", f"{1e-6 * facts.mean_rate:.3f} Mev/s mean, {1e-6 * facts.peak_rate:.3f} Mev/s in the busiest 10 ms"),
        ("brighter", f"{100 * facts.brighter_share:.1f} %{_ONE_POLARITY if facts.brighter_share in (0, 1) else ''}"),
        ("gaps over 10 ms", f"{facts.gap_count}; longest: {longest}" if facts.gap_count else "none"),
        *_faults(facts),
    ]


def _faults(facts: EventInfo) -> list[tuple[str, str]]:
    return [("left out or mended", f"{count:,} {problem}") for problem, count in facts.problems.items()] or [("left out", "nothing")]


def convert_file(source: Input, target: str, format: OutputFormat | None, *, quiet: bool = False) -> int:
    """Write the events of one file into another, say how many; returns the exit code."""
    with warnings.catch_warnings(), progress_shown(quiet=quiet, kernels=False) as progress:
        # Said below, with the counts.
        warnings.filterwarnings("ignore", ".*(some of it was left out|it was mended)", TorchtrackWarning)
        shown = share_of(progress, f"converting {source.path.name}")
        done = convert(source, target, format, shown)
    console = output_console()
    console.print(f"{done.count:,} events are in {target} ({done.format})")
    if done.problems is not None and done.problems.counts:
        console.print(f"left out: {done.problems}", markup=False)
    return ExitCode.DONE

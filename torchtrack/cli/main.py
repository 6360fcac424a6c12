"""The command line: parse → config → call.

Options of a command are typed with tyro. Any setting can be given by its dotted key, as in
``--tracker.window.duration-us 3000``, on top of the config file; ``torchtrack settings`` lists them.
"""

import atexit
import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from torchtrack import __version__
from torchtrack.cli.console import flushed, output_console, report, take_any_text
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.options import Demo, Evaluate, Model, Outline, Settings, Simulate, Track
from torchtrack.cli.options_files import Bench, Convert, Info
from torchtrack.cli.options_pose import Pose
from torchtrack.cli.options_report import Report, View
from torchtrack.config.load import load, typed
from torchtrack.core.limits import Limits, limits
from torchtrack.errors import ConfigError, TorchtrackError
from torchtrack.run.interrupt import ended_in_good_order

# At Python's own rhythm (700) the collector looks through all that is imported again and again: 0.7 of 3.7 s of a short run, here 0.3.
# Little waits for it: 220 windows of tracking leave 7 objects in cycles.
_ALLOCATIONS_BETWEEN_COLLECTIONS = 50_000

_DESCRIPTION = "6DoF object pose tracking with an event camera. `torchtrack --version` says which version this is."
_SETTINGS_HINT = "Any setting can be given by its dotted key, e.g. --tracker.window.duration-us 3000; `torchtrack settings {}` lists them."


_Command = (
    Annotated[Track, subcommand("track", description=f"{Track.__doc__} {_SETTINGS_HINT.format('track')}")]
    | Annotated[Evaluate, subcommand("evaluate", description=f"{Evaluate.__doc__} {_SETTINGS_HINT.format('evaluate')}")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Demo, subcommand("demo")]
    | Annotated[Outline, subcommand("outline")]
    | Annotated[Model, subcommand("model")]
    | Annotated[Pose, subcommand("pose")]
    | Annotated[Report, subcommand("report")]
    | Annotated[View, subcommand("view")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Settings, subcommand("settings")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its :class:`ExitCode`."""
    take_any_text()
    try:
        with ended_in_good_order(), _rare_collections():
            return flushed(_run(sys.argv[1:] if arguments is None else arguments))
    except SystemExit as ended:
        # After a help text, or a mistake in the options.
        raise SystemExit(flushed(ended.code)) from None


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Have the garbage collector run seldom within the block; and not over all that was imported when the process ends, which takes a second."""
    before = gc.get_threshold()
    gc.set_threshold(_ALLOCATIONS_BETWEEN_COLLECTIONS, *before[1:])
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _run(arguments: Sequence[str]) -> int:
    """Run one command; an error is told in one line."""
    if list(arguments) == ["--version"]:
        output_console().print(f"torchtrack {__version__}")
        return ExitCode.DONE
    try:
        options, overrides = split_overrides(arguments)
        command = tyro.cli(_Command, prog="torchtrack", description=_DESCRIPTION, args=options)
        with limits(_limits(overrides)):
            code: int = command.run(overrides)
    except ConfigError as error:
        return report(str(error), ExitCode.WRONG_SETTINGS)
    except TorchtrackError as error:
        return report(str(error), ExitCode.FAILED)
    except OSError as error:
        what = "the system refused" if error.filename is None else f"cannot use '{error.filename}'"
        return report(f"{what}: {error.strerror or error}. Check that it is there, and may be read or written.", ExitCode.FAILED)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    return code


def split_overrides(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Options of the command, and settings given by dotted key as ``--a.b VALUE`` or ``--a.b=VALUE``; dashes in keys count as underscores.

    Raises:
        ConfigError: if a setting has no value.
    """
    options: list[str] = []
    overrides: dict[str, Any] = {}
    rest = iter(arguments)
    for argument in rest:
        name, has_value, value = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or "." not in name:
            options.append(argument)
            continue
        if not has_value:
            following = next(rest, None)
            if following is None or following.startswith("--"):
                raise ConfigError(f"command line: --{name} needs a value, as in --{name} VALUE.")
            value = following
        overrides[name.replace("-", "_")] = typed(value)
    return options, overrides


def _limits(overrides: dict[str, Any]) -> Limits:
    """The limits of files that are given by dotted key; every command takes them."""
    given = {key.removeprefix("limits."): value for key, value in overrides.items() if key.startswith("limits.")}
    return load(Limits, None, given)

"""Standard output and error: what is told there, and what if it cannot be."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.core.atomic import writing
from torchtrack.errors import OutputError

_NAME = "standard output"


class OutputConsole(Console):
    """Standard output. Where nobody reads it any more (a pipe into ``head``) the program ends without a word."""

    def print(self, *objects: Any, **settings: Any) -> None:
        """Print, as :meth:`rich.console.Console.print` does.

        Raises:
            OutputError: if that cannot be, as where the disk is full.
        """
        try:
            with writing(_NAME):
                super().print(*objects, **settings)
        except OutputError:
            _silence()
            raise


class OutputLines:
    """Lines for another program on standard output, each of which is there at once.

    Raises:
        OutputError: if that cannot be, as where nobody reads them any more.
    """

    def write(self, lines: str) -> None:
        """Write lines, each with its end."""
        try:
            with writing(_NAME):
                sys.stdout.write(lines)
                sys.stdout.flush()
        except OutputError:
            _silence()
            raise

    def close(self) -> None:
        """Standard output stays open."""


def take_any_text() -> None:
    """Have both streams show ``?`` in place of what their encoding does not know, as of ``LANG=C``: an error over a ° would hide a result."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def flushed(code: Any) -> Any:
    """The exit code, once all of standard output is written; where it cannot be, that is told, and the code is :attr:`ExitCode.FAILED`."""
    if sys.stdout is None:
        # Closed from the start.
        return code
    try:
        sys.stdout.flush()
    except OSError as error:
        _silence()
        if isinstance(error, BrokenPipeError):
            return ExitCode.FAILED
        return report(f"cannot write to '{_NAME}': {error.strerror}.", ExitCode.FAILED)
    return code


def _silence() -> None:
    """Have standard output go nowhere: what is left of it would be tried, and told, once more when Python ends."""
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def report(text: str, code: int) -> int:
    """Tell one error on stderr, without a traceback; gives the exit code."""
    console = error_console()
    with contextlib.suppress(OSError):
        console.print("error:", style="bold red", end=" ")
        console.print(text, markup=False)
    return code


# Tables need this much where the output is no terminal, which says how wide it is.
_FILE_WIDTH = 200


def output_console() -> Console:
    """Standard output, as wide as the terminal, or as tables need in a file or a pipe."""
    console = OutputConsole(highlight=False, soft_wrap=True)
    return console if console.is_terminal else OutputConsole(highlight=False, soft_wrap=True, width=_FILE_WIDTH)


@contextmanager
def starting(*, quiet: bool = False) -> Iterator[None]:
    """A sign of life on a terminal while the libraries of a command are imported, which takes some seconds on a slow disk."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield
        return
    with console.status("starting"):
        yield


def error_console() -> Console:
    """Standard error, for text that is shown as it is."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def tell_failure(text: str) -> None:
    """Tell on stderr what failed while the rest went on."""
    error_console().print(f"failed: {text}", markup=False)


def tell_warning(text: str) -> None:
    """Tell on stderr what the user should look at."""
    error_console().print(f"warning: {text}", markup=False)

"""The command that measures a part."""

from pathlib import Path
from typing import Literal

from rich.console import Console

from torchtrack.bench import io, sim
from torchtrack.bench.results import as_markdown, write_results
from torchtrack.commands import output_console
from torchtrack.errors import ConfigError
from torchtrack.exit_codes import ExitCode


def bench(part: Literal["io", "sim"], output: str, *, repeats: int, events: int) -> int:
    """Measure a part, show and write the figures; returns the exit code."""
    if repeats < 1 or events < 1:
        raise ConfigError(f"command line: --repeats and --events must be at least 1, got {repeats} and {events}.")
    with Console(stderr=True).status(f"measuring {part}") as status:

        def show(name: str) -> None:
            status.update(f"measuring {part}: {name}")

        results = io.measure(events, repeats, show) if part == "io" else sim.measure(repeats, show)
    title = {"io": "Reading events, one core", "sim": "Simulating, 640x480, an object of 10k faces, one core"}[part]
    write_results(Path(output), part, title, results)
    output_console().print(as_markdown(title, results), markup=False)
    return ExitCode.DONE

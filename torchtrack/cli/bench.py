"""The command that measures a part, or all of them."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import get_args

import torch
from rich.console import Console

from torchtrack.bench.parts import Part
from torchtrack.bench.results import Report, as_markdown, machine, older_medians, write_results
from torchtrack.bench.setup import Setup
from torchtrack.bench.yardstick import Yardstick
from torchtrack.cli.console import error_console, output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.core.atomic import check_writable
from torchtrack.errors import ConfigError, MissingExtraError
from torchtrack.run.runner import threads


def bench(part: str, output: Path, compare: Path | None, setup: Setup) -> int:
    """Measure a part or ``all``, show and write the figures; returns the exit code.

    Args:
        part: one of :data:`~torchtrack.bench.parts.Part`, or ``all``.
        output: folder for the results.
        compare: earlier results: a file, or a folder of them.
        setup: how to measure.

    Raises:
        ConfigError: if an option is out of bounds, or ``compare`` holds something else.
        MissingFileError: if there is nothing to compare with.
        OutputError: if the folder cannot be written into.
        MissingExtraError: if a part needs a library that is not installed; of ``all``, that part is left out.
    """
    _check(compare, part, setup)
    check_writable(output / "bench.json")
    parts = get_args(Part) if part == "all" else (part,)
    older = {name: older_medians(compare, name) for name in parts} if compare is not None else {}
    with threads(setup.threads):
        for name in parts:
            try:
                report = _measured(name, setup)
            except MissingExtraError as error:
                if part != "all":
                    raise
                error_console().print(f"left out: {name}: {error}", markup=False)
                continue
            _tell(report, output, setup, older.get(name))
    return ExitCode.DONE


def bench_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        ConfigError: if there is no such device here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"command line: --device must be cpu, cuda or cuda:N, got '{name}'.") from error
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"command line: --device must be cpu, cuda or cuda:N, got '{name}'.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"command line: --device {name}: PyTorch sees {torch.cuda.device_count()} GPUs here. Measure on the CPU with --device cpu.")
    return device


def _check(compare: Path | None, part: str, setup: Setup) -> None:
    """Raise :class:`ConfigError` for what makes no sense."""
    if setup.repeats < 1 or setup.events < 1 or setup.threads < 1:
        given = f"{setup.repeats}, {setup.events} and {setup.threads}"
        raise ConfigError(f"command line: --repeats, --events and --threads must be at least 1, got {given}.")
    if part == "all" and compare is not None and not compare.is_dir():
        raise ConfigError(f"command line: to compare all parts, give --compare the folder of the earlier results; '{compare}' is none.")


def _measured(part: str, setup: Setup) -> Report:
    """The report of a part, with the yardstick before and after it: a machine that others use may get slower meanwhile."""
    with Console(stderr=True).status(f"measuring {part}") as status:
        setup_of_part = replace(setup, show=lambda name: status.update(f"measuring {part}: {name}"))
        yardstick = Yardstick()
        before = yardstick.time(setup.repeats)
        # Only what is measured is loaded.
        report: Report = import_module(f"torchtrack.bench.{part}").measure(setup_of_part)
        after = yardstick.time(setup.repeats)
    return replace(report, yardstick=replace(before, figures=before.figures + after.figures))


def _tell(report: Report, output: Path, setup: Setup, older: dict[str, float] | None) -> None:
    """Write a report, and show it."""
    facts = machine(setup.device)
    write_results(output, report, facts, older)
    output_console().print(as_markdown(report, facts, older), markup=False)

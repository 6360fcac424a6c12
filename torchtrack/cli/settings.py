"""``torchtrack settings``: every setting of a command."""

from collections.abc import Iterator
from itertools import groupby

from rich.markup import escape
from rich.table import Column, Table

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.config.demo import DemoConfig
from torchtrack.config.describe import described
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import Settings
from torchtrack.errors import ConfigError
from torchtrack.sim import SceneConfig

_Row = tuple[str, str, str, str]
_COLUMNS = ("setting", "type", "default", "meaning")
_SETTINGS: dict[str, type[Settings]] = {"track": RunConfig, "evaluate": EvaluateConfig, "demo": DemoConfig, "simulate": SceneConfig}

# How much of files is taken is of no use to most.
_FOLDED = ("limits",)


def list_settings(command: str, group: str, *, markdown: bool) -> int:
    """Show the settings of a command, a line each, or a group of them in full, or all as Markdown; returns the exit code.

    Raises:
        ConfigError: if there is no such group.
    """
    if markdown:
        output_console().print(as_markdown(command), markup=False, highlight=False, soft_wrap=True, end="")
        return ExitCode.DONE
    rows = list(described(_SETTINGS[command]))
    if group:
        table = Table(*_COLUMNS, header_style="bold", box=None)
        for row in _of_group(rows, group, command):
            table.add_row(*(escape(cell) for cell in row))
    else:
        # Meanings are cut where a line ends.
        table = Table(Column("setting", no_wrap=True), "default", Column("meaning", no_wrap=True, overflow="ellipsis"), header_style="bold", box=None)
        for key, _, default, meaning in _folded(rows, command):
            table.add_row(escape(key), escape(default), escape(meaning))
    output_console().print(table)
    return ExitCode.DONE


def _of_group(rows: list[_Row], group: str, command: str) -> list[_Row]:
    chosen = [row for row in rows if group in row[0]]
    if not chosen:
        raise ConfigError(f"'{command}' has no setting with '{group}' in its name. 'torchtrack settings {command}' lists them.")
    return chosen


def _folded(rows: list[_Row], command: str) -> Iterator[_Row]:
    """The rows, with groups that hardly anybody needs in a single one."""
    for first, of_first in groupby(rows, key=lambda row: row[0].partition(".")[0]):
        if first in _FOLDED:
            yield f"{first}.*", "", "", f"{len(list(of_first))} settings: torchtrack settings {command} {first}"
        else:
            yield from of_first


def as_markdown(command: str) -> str:
    """The settings of a command as a table in Markdown."""
    rows = [_COLUMNS, ("---",) * len(_COLUMNS), *((f"`{key}`", *rest) for key, *rest in described(_SETTINGS[command]))]
    return "".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in row)} |\n" for row in rows)

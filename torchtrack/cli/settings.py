"""``torchtrack settings``: every setting of a command."""

from rich.table import Table

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.config.demo import DemoConfig
from torchtrack.config.describe import described
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import Settings
from torchtrack.sim import SceneConfig

_COLUMNS = ("setting", "type", "default", "meaning")
_SETTINGS: dict[str, type[Settings]] = {"track": RunConfig, "evaluate": EvaluateConfig, "demo": DemoConfig, "simulate": SceneConfig}


def list_settings(command: str, *, markdown: bool) -> int:
    """Show every setting of a command, as a table or as Markdown; returns the exit code."""
    if markdown:
        output_console().print(as_markdown(command), markup=False, highlight=False, soft_wrap=True, end="")
        return ExitCode.DONE
    table = Table(*_COLUMNS, header_style="bold", box=None)
    for row in described(_SETTINGS[command]):
        table.add_row(*row)
    output_console().print(table)
    return ExitCode.DONE


def as_markdown(command: str) -> str:
    """The settings of a command as a table in Markdown."""
    rows = [_COLUMNS, ("---",) * len(_COLUMNS), *((f"`{key}`", *rest) for key, *rest in described(_SETTINGS[command]))]
    return "".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in row)} |\n" for row in rows)

"""What the command ``report`` does: folders of runs in, one HTML page out."""

from collections.abc import Sequence
from pathlib import Path

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.core.atomic import check_writable
from torchtrack.errors import ConfigError
from torchtrack.report import write_report


def report(folders: Sequence[Path], output: Path | None) -> int:
    """Write the page, and say where it is; returns the exit code."""
    if not folders:
        raise ConfigError("command line: report needs the output folder of a run, or several.")
    page = output if output is not None else folders[0] / "report.html"
    if page.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"command line: '{page}': the report is an .html file. Give it such a name.")
    if folders[0].is_dir() or output is not None:
        check_writable(page)
    write_report(folders, page)
    output_console().print(f"The report is in {page}", markup=False)
    return ExitCode.DONE

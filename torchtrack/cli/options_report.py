"""The options of the command about finished runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from torchtrack.cli.option import option
from torchtrack.cli.options_files import refuse_settings


@dataclass(frozen=True)
class Report:
    """Write one HTML page of finished runs, side by side: tables, plots, stills, video, settings; it opens without a network."""

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="DIR ...")]]
    """Output folders of runs."""
    output: Annotated[Path | None, option("FILE", "-o")] = None
    """The page to write (.html); by default report.html in the first folder."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        from torchtrack.cli.report import report

        refuse_settings(overrides)
        return report(self.runs, self.output)

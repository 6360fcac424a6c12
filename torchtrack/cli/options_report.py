"""The options of the commands about finished runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from torchtrack.cli.console import starting
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


@dataclass(frozen=True)
class View:
    """Show a finished run in the Rerun viewer: events, contours, meshes, trajectories, status and quality on one time line; or plot it."""

    folder: Positional[Annotated[Path, arg(metavar="DIR")]]
    """Output folder of a run."""
    output: Annotated[Path | None, option("FILE", "-o")] = None
    """Write a file for the viewer (.rrd), and do not open it."""
    source: Annotated[Path | None, option("FILE")] = None
    """The recording, if it is no longer where it was tracked from."""
    plots: Annotated[Path | None, option("DIR")] = None
    """Write plots (.png) of status, accuracy and trajectory into this folder; no viewer is opened."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        refuse_settings(overrides)
        with starting(quiet=self.quiet):
            from torchtrack.cli.view import view

        return view(self.folder, self.output, self.source, self.plots, quiet=self.quiet)

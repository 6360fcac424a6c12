"""What the command ``view`` does: the folder of a run in, the Rerun viewer or its file and plots out."""

from pathlib import Path

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.progress import progress_shown, share_of
from torchtrack.report.finished import read_run
from torchtrack.report.plots import write_plots
from torchtrack.report.replay import show_run
from torchtrack.run.sinks.rerun_log import LIVE


def view(folder: Path, output: Path | None, source: Path | None, plots: Path | None, *, quiet: bool) -> int:
    """Show a finished run, say where what was written is; returns the exit code."""
    run, console = read_run(folder), output_console()
    if plots is not None:
        write_plots(run, plots)
        console.print(f"The plots are in {plots}", markup=False)
    if plots is None or output is not None:
        with progress_shown(quiet=quiet) as progress:
            show_run(run, LIVE if output is None else str(output), source, share_of(progress, f"showing {run.name}"))
        console.print("The run is in the Rerun viewer" if output is None else f"The log is in {output}: rerun {output} opens it", markup=False)
    return ExitCode.DONE

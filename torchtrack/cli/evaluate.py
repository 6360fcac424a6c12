"""``torchtrack evaluate``: methods compared on sequences, and the latency of their events."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.progress import Progress, TaskID
from rich.table import Table

from torchtrack.cli.console import output_console, tell_failure
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.progress import progress_shown
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.load import load, read_yaml
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.core.files import naming
from torchtrack.eval.evaluate import evaluate as evaluate_all
from torchtrack.eval.evaluate import plan, report_of
from torchtrack.eval.grid import markdown
from torchtrack.eval.latency import estimate_latency
from torchtrack.eval.sources import find_sequences
from torchtrack.eval.tables import results_table
from torchtrack.run.session import open_session


def evaluate(config_file: str | None, given: Mapping[str, Any], overrides: Mapping[str, Any], chosen: Sequence[str] | None, *, quiet: bool) -> int:
    """Evaluate sequences, show the table; returns the exit code, which is not 0 where a sequence failed."""
    console = output_console()
    path = Path(config_file) if config_file else None
    config = load(EvaluateConfig, path, _method_overrides(path, overrides, chosen) | dict(given))
    if chosen is not None:
        config = config.model_copy(update={"methods": {label: config.methods[label] for label in chosen}})
    # What is wrong is told with the file that asks for it.
    with progress_shown(quiet=quiet) as progress, naming(path):
        planned = plan(config, _scene_progress(progress))
        bar = progress.add_task("sequences", total=len(planned.jobs))
        evaluation = evaluate_all(config, lambda job: progress.advance(bar), planned)
    if report := report_of(evaluation, config, planned):
        for grid in report.grids:
            # As it is: markup and wrapping would break it.
            console.print(markdown(grid), markup=False, no_wrap=True, overflow="ignore", crop=False, end="\n\n")
    else:
        console.print(results_table(evaluation))
    for reason in dict.fromkeys(f"{entry.method}: {entry.reason}" for entry in evaluation.not_applicable):
        console.print(f"- {reason}", markup=False)
    console.print(f"Results are in {config.output}")
    for failure in evaluation.failures:
        tell_failure(f"{failure.sequence} ({failure.method}): {failure.reason}")
    return ExitCode.FAILED if evaluation.failures else ExitCode.DONE


def show_latency(paths: Sequence[str]) -> int:
    """Show how late the events of sequences are against their ground truth; returns the exit code."""
    table = Table("sequence", "latency (µs)", "± (µs)", "lag (px)", "distance before → after (px)", header_style="bold")
    for path in find_sequences([Path(text) for text in paths]):
        latency = estimate_latency(open_session(RunConfig(source=path)))
        row = (
            f"{latency.latency_us:.0f}",
            f"{latency.deviation_us:.0f}",
            f"{latency.lag_px:.2f}",
            f"{latency.before_px:.2f} → {latency.after_px:.2f}",
        )
        table.add_row(path.stem, *row)
    console = output_console()
    console.print(table)
    console.print("The setting sensor_latency_us of a run takes a latency off.")
    return ExitCode.DONE


def _scene_progress(progress: Progress) -> Callable[[str, float], None]:
    """Shows how far each scene is simulated."""
    bars: dict[str, TaskID] = {}

    def show(name: str, share: float) -> None:
        if name not in bars:
            bars[name] = progress.add_task(f"simulating {name}", total=1.0)
        progress.update(bars[name], completed=share)

    return show


def _method_overrides(config_file: Path | None, overrides: Mapping[str, Any], chosen: Sequence[str] | None) -> dict[str, Any]:
    """Overrides with what names no method laid over every one; a chosen method that the file does not know is a preset."""
    given = (read_yaml(config_file) if config_file else {}).get("methods")
    # Anything else is told when the settings are checked.
    of_file = given if isinstance(given, dict) else {}
    labels = list(chosen or of_file or ["default"])
    result = {f"methods.{label}.preset": CommandLineText(label) for label in labels if label not in of_file}
    for key, value in overrides.items():
        keys = [f"methods.{label}.{key}" for label in labels] if key.startswith("tracker.") else [key]
        result |= dict.fromkeys(keys, value)
    return result

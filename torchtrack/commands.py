"""What each command of the command line does, apart from parsing: settings in, work, tables out."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from torchtrack.config.describe import described
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.load import load, read_yaml
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.eval.evaluate import evaluate as evaluate_all
from torchtrack.eval.evaluate import find_sequences
from torchtrack.eval.tables import results_table, run_table
from torchtrack.runner import run
from torchtrack.sinks.progress import ProgressBar

EXIT_FAILED, EXIT_INTERRUPTED = 1, 130


def track(config_or_source: str, overrides: Mapping[str, Any], *, quiet: bool) -> int:
    """Track one source, show the summary; returns the exit code."""
    console = Console()
    if Path(config_or_source).suffix.lower() in (".yaml", ".yml"):
        config = load(RunConfig, Path(config_or_source), overrides)
    else:
        config = load(RunConfig, None, {"source": CommandLineText(config_or_source), **overrides})
    progress = [] if quiet else [ProgressBar(Console(stderr=True), config.source.name)]
    summary = run(config, progress)
    console.print(run_table(summary))
    console.print(f"Results are in {config.output}", highlight=False, soft_wrap=True)
    return EXIT_INTERRUPTED if summary.interrupted else 0


def evaluate(config_file: str | None, given: Mapping[str, Any], overrides: Mapping[str, Any], chosen: Sequence[str] | None, *, quiet: bool) -> int:
    """Evaluate sequences, show the table; returns the exit code, which is not 0 where a sequence failed."""
    console = Console()
    path = Path(config_file) if config_file else None
    config = load(EvaluateConfig, path, _method_overrides(path, overrides, chosen) | dict(given))
    if chosen is not None:
        config = config.model_copy(update={"methods": {label: config.methods[label] for label in chosen}})
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress:
        bar = progress.add_task("sequences", total=len(find_sequences(config.paths)) * len(config.methods))
        evaluation = evaluate_all(config, lambda job: progress.advance(bar))
    console.print(results_table(evaluation.results))
    console.print(f"Results are in {config.output}", highlight=False, soft_wrap=True)
    for failure in evaluation.failures:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"failed: {failure.sequence} ({failure.method}): {failure.reason}", markup=False)
    return EXIT_FAILED if evaluation.failures else 0


def _method_overrides(config_file: Path | None, overrides: Mapping[str, Any], chosen: Sequence[str] | None) -> dict[str, Any]:
    """Overrides with what names no method laid over every one; a chosen method that the file does not know is a preset."""
    of_file = (read_yaml(config_file) if config_file else {}).get("methods") or {}
    labels = list(chosen or of_file or ["default"])
    result = {f"methods.{label}.preset": CommandLineText(label) for label in labels if label not in of_file}
    for key, value in overrides.items():
        keys = [f"methods.{label}.{key}" for label in labels] if key.startswith("tracker.") else [key]
        result |= dict.fromkeys(keys, value)
    return result


def list_settings(command: str) -> int:
    """Show every setting of a command; returns the exit code."""
    table = Table(title=f"Settings of torchtrack {command}", header_style="bold")
    table.add_column("setting", no_wrap=True)
    for name in ("type", "default", "meaning"):
        table.add_column(name, overflow="fold")
    for row in described({"track": RunConfig, "evaluate": EvaluateConfig}[command]):
        table.add_row(*row)
    Console().print(table)
    return 0

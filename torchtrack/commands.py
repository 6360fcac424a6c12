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
from torchtrack.config.settings import CommandLineText, Settings
from torchtrack.eval.evaluate import evaluate as evaluate_all
from torchtrack.eval.evaluate import find_sequences
from torchtrack.eval.tables import results_table, run_headline, run_table
from torchtrack.runner import run
from torchtrack.sinks.progress import ProgressBar

EXIT_FAILED, EXIT_INTERRUPTED = 1, 130
# Tables need this much where the output is no terminal, which says how wide it is.
_FILE_WIDTH = 160


def output_console() -> Console:
    """Standard output, as wide as the terminal, or as tables need in a file or a pipe."""
    console = Console(highlight=False, soft_wrap=True)
    return console if console.is_terminal else Console(highlight=False, soft_wrap=True, width=_FILE_WIDTH)


def track(config_or_source: str, overrides: Mapping[str, Any], *, quiet: bool) -> int:
    """Track one source, show the summary; returns the exit code."""
    console = output_console()
    if Path(config_or_source).suffix.lower() in (".yaml", ".yml"):
        config = load(RunConfig, Path(config_or_source), overrides)
    else:
        config = load(RunConfig, None, {"source": CommandLineText(config_or_source), **overrides})
    progress = [] if quiet else [ProgressBar(Console(stderr=True), config.source.name)]
    summary = run(config, progress)
    console.print(run_headline(summary))
    console.print(run_table(summary))
    console.print(f"Results are in {config.output}")
    return EXIT_INTERRUPTED if summary.interrupted else 0


def evaluate(config_file: str | None, given: Mapping[str, Any], overrides: Mapping[str, Any], chosen: Sequence[str] | None, *, quiet: bool) -> int:
    """Evaluate sequences, show the table; returns the exit code, which is not 0 where a sequence failed."""
    console = output_console()
    path = Path(config_file) if config_file else None
    config = load(EvaluateConfig, path, _method_overrides(path, overrides, chosen) | dict(given))
    if chosen is not None:
        config = config.model_copy(update={"methods": {label: config.methods[label] for label in chosen}})
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress:
        bar = progress.add_task("sequences", total=len(find_sequences(config.paths)) * len(config.methods))
        evaluation = evaluate_all(config, lambda job: progress.advance(bar))
    console.print(results_table(evaluation.results))
    console.print(f"Results are in {config.output}")
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
    table = Table("setting", "type", "default", "meaning", header_style="bold", box=None)
    settings: dict[str, type[Settings]] = {"track": RunConfig, "evaluate": EvaluateConfig}
    for row in described(settings[command]):
        table.add_row(*row)
    output_console().print(table)
    return 0

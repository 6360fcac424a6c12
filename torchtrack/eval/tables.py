"""Tables of errors for the terminal."""

from collections.abc import Sequence

from rich.table import Table

from torchtrack.eval.evaluate import ObjectResult
from torchtrack.sinks.summary import RunSummary


def results_table(results: Sequence[ObjectResult], title: str = "") -> Table:
    """One row per sequence, object and method."""
    table = Table(title=title or None, header_style="bold")
    for name in ("sequence", "object", "method"):
        table.add_column(name)
    for name in ("windows", "mean δR °", "δT mm", "median δR °", "δT mm", "max δR °", "δT mm", "lost %", "ms/step"):
        table.add_column(name, justify="right")
    for result in results:
        metrics = result.metrics
        table.add_row(
            result.sequence,
            result.object,
            result.method,
            str(metrics.windows),
            *_pair(metrics.mean_rotation_deg, metrics.mean_translation_cm),
            *_pair(metrics.median_rotation_deg, metrics.median_translation_cm),
            *_pair(metrics.max_rotation_deg, metrics.max_translation_cm),
            f"{100 * metrics.lost_fraction:.1f}",
            f"{result.median_step_ms:.1f}",
        )
    return table


def _pair(rotation_deg: float, translation_cm: float) -> tuple[str, str]:
    """A rotation in degrees and a translation in millimetres: centimetres would hide what matters."""
    return f"{rotation_deg:.3f}", f"{10 * translation_cm:.2f}"


def run_table(summary: RunSummary) -> Table:
    """One row per object of a run."""
    title = (
        f"{summary.source}: {summary.windows} windows, {summary.events} events in {summary.duration_s:.3f} s, "
        f"{summary.step_median_ms:.1f} ms/step, {summary.real_time_factor:.2f}x real time"
    )
    table = Table(title=title, header_style="bold")
    table.add_column("object")
    for name in ("mean δR °", "δT mm", "max δR °", "δT mm", "lost %", "quality"):
        table.add_column(name, justify="right")
    table.add_column("status")
    for label, of_object in summary.objects.items():
        errors = of_object.errors
        cells = ("-",) * 5
        if errors is not None:
            mean, worst = _pair(errors.mean_rotation_deg, errors.mean_translation_cm), _pair(errors.max_rotation_deg, errors.max_translation_cm)
            cells = (*mean, *worst, f"{100 * errors.lost_fraction:.1f}")
        statuses = ", ".join(f"{name} {count}" for name, count in of_object.status.items())
        table.add_row(label, *cells, f"{of_object.mean_quality:.2f}", statuses)
    return table

"""Errors and speed as tables for the terminal."""

from collections.abc import Sequence

from rich.table import Table

from torchtrack.eval.evaluate import ObjectResult
from torchtrack.sinks.summary import RunSummary


def results_table(results: Sequence[ObjectResult]) -> Table:
    """One row per sequence, object and method; each error is a rotation and a translation."""
    table = Table(header_style="bold")
    for name in ("sequence", "object", "method"):
        table.add_column(name, no_wrap=True)
    for name in ("windows", "mean", "median", "max", "lost", "step"):
        table.add_column(name, justify="right", no_wrap=True)
    for result in results:
        metrics = result.metrics
        table.add_row(
            result.sequence,
            result.object,
            result.method,
            str(metrics.windows),
            _error(metrics.mean_rotation_deg, metrics.mean_translation_cm),
            _error(metrics.median_rotation_deg, metrics.median_translation_cm),
            _error(metrics.max_rotation_deg, metrics.max_translation_cm),
            f"{100 * metrics.lost_fraction:.1f}%",
            f"{result.median_step_ms:.1f} ms",
        )
    return table


def _error(rotation_deg: float, translation_cm: float) -> str:
    """A rotation in degrees and a translation in millimetres: centimetres would hide what matters."""
    return f"{rotation_deg:.3f}° {10 * translation_cm:6.2f} mm"


def run_table(summary: RunSummary) -> Table:
    """One row per object of a run."""
    table = Table(header_style="bold")
    table.add_column("object", no_wrap=True)
    for name in ("mean error", "max error", "lost", "quality"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("windows by status")
    for label, of_object in summary.objects.items():
        errors = of_object.errors
        cells = ("-", "-", "-")
        if errors is not None:
            mean, worst = _error(errors.mean_rotation_deg, errors.mean_translation_cm), _error(errors.max_rotation_deg, errors.max_translation_cm)
            cells = (mean, worst, f"{100 * errors.lost_fraction:.1f}%")
        statuses = ", ".join(f"{name} {count}" for name, count in of_object.status.items())
        table.add_row(label, *cells, f"{of_object.mean_quality:.2f}", statuses)
    return table


def run_headline(summary: RunSummary) -> str:
    """How much was tracked and how fast, in one line."""
    return (
        f"{summary.source}: {summary.windows} windows, {summary.events} events in {summary.duration_s:.3f} s "
        f"({summary.event_rate_per_s / 1e6:.2f} Mev/s); {summary.step_median_ms:.1f} ms a step, {summary.tracking_real_time_factor:.2f}x real time "
        f"({summary.real_time_factor:.2f}x with reading, drawing and writing)"
    )

"""Errors and speed as tables for the terminal."""

import math
from collections.abc import Mapping

from rich.table import Table

from torchtrack.eval.results import Evaluation, NotApplicable, ObjectResult
from torchtrack.run.sinks.summary import RunSummary


def results_table(evaluation: Evaluation) -> Table:
    """One row per sequence, object and method; each error is a rotation and a translation.

    ``peak`` is the largest error after the first 50 ms, by the mean. A method that is not made for an object has ``-``.
    """
    table = Table(header_style="bold")
    for name in ("sequence", "object", "method"):
        table.add_column(name, no_wrap=True)
    for name in ("mean", "median", "max", "peak", "lost", "step"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("windows by status")
    entries: list[ObjectResult | NotApplicable] = [*evaluation.results, *evaluation.not_applicable]
    order = list(dict.fromkeys(entry.sequence for entry in entries))
    for entry in sorted(entries, key=lambda entry: order.index(entry.sequence)):
        table.add_row(entry.sequence, entry.object, entry.method, *(_figures(entry) if isinstance(entry, ObjectResult) else ["-"] * 7))
    return table


def _figures(result: ObjectResult) -> tuple[str, ...]:
    metrics = result.metrics
    return (
        _error(metrics.mean_rotation_deg, metrics.mean_translation_cm),
        _error(metrics.median_rotation_deg, metrics.median_translation_cm),
        _error(metrics.max_rotation_deg, metrics.max_translation_cm),
        f"{metrics.peak_rotation:.1f} {metrics.peak_translation:.1f}",
        f"{100 * metrics.lost_fraction:.1f}%",
        f"{result.median_step_ms:.1f} ms",
        _statuses(result.status),
    )


def _statuses(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


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
        quality = f"{of_object.mean_quality:.2f}" if math.isfinite(of_object.mean_quality) else "-"
        table.add_row(label, *cells, quality, _statuses(of_object.status))
    return table


def run_headline(summary: RunSummary) -> str:
    """How much was tracked and how fast, in one line."""
    return (
        f"{summary.source}: {summary.windows} windows, {summary.events} events in {summary.duration_s:.3f} s "
        f"({summary.event_rate_per_s / 1e6:.2f} Mev/s); {summary.step_median_ms:.1f} ms a step, {summary.tracking_real_time_factor:.2f}x real time "
        f"({summary.real_time_factor:.2f}x with reading, drawing and writing)"
    )

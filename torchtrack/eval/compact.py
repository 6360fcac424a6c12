"""One row per method, one column per object: an ablation at a glance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from torchtrack.eval.grid import Cell, Grid, Report
from torchtrack.eval.results import Evaluation, ObjectResult

_TITLE = "Mean error of each method, rotation in ° / translation in mm"
# A share of lost windows from which a cell says so.
_LOST_SHOWN = 0.005


@dataclass(frozen=True)
class _Overall:
    """Means over the objects that every method tracked."""

    rotation_deg: float
    translation_mm: float
    lost_fraction: float
    peak: float
    step_ms: float


def compact_report(evaluation: Evaluation, methods: Sequence[str]) -> Report:
    """Mean errors of every object, their mean, how this differs from that of the first method, lost windows and time.

    The means are over those objects that every method tracked, so that they can be compared. A cell with lost windows
    says how many. ``peak`` is the largest error after the first 50 ms by the mean, of the object where this is worst.
    """
    by_place = {(result.method, result.sequence, result.object): result for result in evaluation.results}
    measured = [(result.sequence, result.object) for result in evaluation.results]
    columns = list(dict.fromkeys([*measured, *((entry.sequence, entry.object) for entry in evaluation.not_applicable)]))
    shared = [column for column in columns if all((method, *column) in by_place for method in methods)]
    overall = {method: _overall([by_place[method, *column] for column in shared]) for method in methods}
    rows = tuple(_row(method, [by_place.get((method, *column)) for column in columns], overall[method], overall[methods[0]]) for method in methods)
    names = [*(_column_name(*column, columns) for column in columns), "mean", "change", "lost", "peak", "step"]
    header = (Cell("method"), *(Cell(name) for name in names))
    note = f"Mean, change, lost and step: over the {len(shared)} of {len(columns)} objects that every method tracked; change: to {methods[0]}."
    return Report((Grid(_TITLE, (header,), rows, (note,)),), tuple(result.as_row() for result in evaluation.results))


def _column_name(sequence: str, label: str, columns: Sequence[tuple[str, str]]) -> str:
    """The sequence, and which of its objects where it has several."""
    return sequence if sum(other == sequence for other, _ in columns) == 1 else f"{sequence}: {label}"


def _overall(results: Sequence[ObjectResult]) -> _Overall | None:
    """The means; None where there is nothing to take them of."""
    if not results:
        return None
    metrics = [result.metrics for result in results]
    return _Overall(
        fmean(entry.mean_rotation_deg for entry in metrics),
        10 * fmean(entry.mean_translation_cm for entry in metrics),
        fmean(entry.lost_fraction for entry in metrics),
        max(max(entry.peak_rotation, entry.peak_translation) for entry in metrics),
        fmean(result.median_step_ms for result in results),
    )


def _row(method: str, results: Sequence[ObjectResult | None], overall: _Overall | None, first: _Overall | None) -> tuple[Cell, ...]:
    texts = ["-"] * 5 if overall is None or first is None else _means(overall, first)
    return (Cell(method), *(Cell(_cell(result)) for result in results), *(Cell(text) for text in texts))


def _means(overall: _Overall, first: _Overall) -> list[str]:
    change = f"{overall.rotation_deg - first.rotation_deg:+.3f} / {overall.translation_mm - first.translation_mm:+.2f}"
    return [
        _errors(overall.rotation_deg, overall.translation_mm),
        change if overall is not first else "",
        f"{100 * overall.lost_fraction:.1f} %",
        f"{overall.peak:.1f}" if math.isfinite(overall.peak) else "-",
        f"{overall.step_ms:.1f} ms",
    ]


def _cell(result: ObjectResult | None) -> str:
    if result is None:
        return "-"
    metrics = result.metrics
    lost = f" ({100 * metrics.lost_fraction:.0f} % lost)" if metrics.lost_fraction >= _LOST_SHOWN else ""
    return _errors(metrics.mean_rotation_deg, 10 * metrics.mean_translation_cm) + lost


def _errors(rotation_deg: float, translation_mm: float) -> str:
    return f"{rotation_deg:.2f} / {translation_mm:.2f}"

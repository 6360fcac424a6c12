"""What each component is worth: every method, which leaves some out, against the first, which has them all.

Methods run several times, with other roundings each time. Figures of a run are means over tracks, one track per object and sequence:

- lost: the share of windows of a track that are lost,
- δR and δT: the mean error over its windows that are not lost. One lost window may be off by 90°: it says nothing of accuracy.

A change is the mean over a method's runs less that over the first method's. Errors are compared on the windows that no run of
either has lost, so that losing the difficult ones is no gain. A change counts if it is larger than

- twice its standard deviation between runs, which is that of a mean over the runs of each; that between the runs of one method is at
  least that of all methods together, as three runs tell little of their own;
- twice its standard error over tracks: one track of many that is lost by one method and not by another is chance, even if it is so
  in all runs, as a run that differs by roundings alone may go wrong in the same way;
- 1 % of an error, or 0.1 % of the windows.

How many tracks differ at all, in runs from the same start, tells where a part never does anything: there, no change is chance.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from statistics import fmean, variance
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from torchtrack.eval.grid import Cell, Grid, Report
from torchtrack.eval.results import Evaluation, ObjectResult
from torchtrack.run.metrics import PoseErrors, is_lost

# Standard deviations of a change from which it counts.
_SIGMAS = 2.0
# The least change that counts: as a share of an error, and of all windows.
_LEAST_RELATIVE, _LEAST_LOST = 0.01, 0.001
_NOTE = (
    "±: standard deviation between runs. δR, δT: over windows that are not lost; their changes: over windows that no run of either has lost. "
    "Changes: to the first row, larger than 0 where leaving out is worse. Differ: tracks with another digit, of runs from the same start."
)

Track = tuple[str, str]
"""A sequence, and which of its objects."""
Arm = Mapping[Track, ObjectResult]
"""All tracks of one run of a method."""
Limits = tuple[float, float]
"""From which rotation (degrees) and translation (cm) on a window counts as lost."""


class Figures(NamedTuple):
    """Means over tracks; NaN where nothing is to be averaged."""

    rotation_deg: float
    translation_mm: float
    lost: float


_NO_FIGURES = Figures(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Comparison:
    """A method against the first one.

    Args:
        own: what was measured in each run.
        with_all, without: of each run of the first method and of this one, on the windows that both have.
        over_tracks: standard errors of the change over tracks.
        differing: tracks of which any error has another digit, in runs of the same number.
    """

    own: Sequence[Figures]
    with_all: Sequence[Figures]
    without: Sequence[Figures]
    over_tracks: Figures = _NO_FIGURES
    differing: int = 0

    @property
    def change(self) -> Figures:
        """The mean of this method less that of the first: larger than 0 where it is worse."""
        pairs = zip(zip(*self.without, strict=True), zip(*self.with_all, strict=True), strict=True)
        return Figures(*(fmean(ours) - fmean(theirs) for ours, theirs in pairs))


def trial_report(evaluation: Evaluation, methods: Sequence[str], sequences: Sequence[str], limits: Limits) -> Report:
    """One row per method: its figures, how they differ from the first method's, and whether that is more than chance; lost windows by kind.

    Runs that are not complete are left out, and so are sequences that failed under any method.

    Args:
        evaluation: what was measured.
        methods: labels; the first is what all are compared to.
        sequences: names of all that are to be measured; the kind of a scene is its name up to the first ``_``.
        limits: from where on a window counts as lost.
    """
    failed = {failure.sequence for failure in evaluation.failures}
    arms = complete_arms(evaluation.results, [name for name in sequences if name not in failed])
    done = [method for method in methods if method in arms] if methods[0] in arms else []
    comparisons = {method: compared(arms[methods[0]], arms[method], limits) for method in done}
    spread = pooled_spread(list(comparisons.values()))
    grids = (_grid(comparisons, spread, len(methods), failed), _by_kind({method: arms[method] for method in done}, limits))
    return Report(grids, tuple(result.as_row() for result in evaluation.results))


def complete_arms(results: Sequence[ObjectResult], sequences: Sequence[str]) -> dict[str, list[Arm]]:
    """The runs of each method that have every sequence."""
    by_run: dict[tuple[str, int], dict[Track, ObjectResult]] = {}
    for result in results:
        if result.sequence in sequences:
            by_run.setdefault((result.method, result.run), {})[result.sequence, result.object] = result
    arms: dict[str, list[Arm]] = {}
    for (method, _), arm in sorted(by_run.items(), key=lambda item: item[0][1]):
        if {sequence for sequence, _ in arm} == set(sequences):
            arms.setdefault(method, []).append(arm)
    return arms


def compared(first: Sequence[Arm], other: Sequence[Arm], limits: Limits) -> Comparison:
    """The runs of a method against those of the first one."""
    tracks = [track for track in first[0] if all(track in arm for arm in (*first, *other))]
    held = {track: reduce(np.intersect1d, [_held_us(arm[track].errors, limits) for arm in (*first, *other)]) for track in tracks}
    own = [_figures(arm, {track: _held_us(result.errors, limits) for track, result in arm.items()}, limits) for arm in other]
    with_all, without = ([_figures(arm, held, limits) for arm in arms] for arms in (first, other))
    differing = sum(_differs(track, first, other) for track in tracks)
    return Comparison(own, with_all, without, _standard_errors(first, other, held, limits), differing)


def _differs(track: Track, first: Sequence[Arm], other: Sequence[Arm]) -> bool:
    """Whether runs of the same number, which have the same start, differ in any digit of a track's errors."""
    of_run = {arm[track].run: arm[track].errors for arm in first}
    pairs = [(of_run[arm[track].run], arm[track].errors) for arm in other if arm[track].run in of_run]
    return not all(np.array_equal(ours, theirs, equal_nan=True) for pair in pairs for ours, theirs in zip(*map(_numbers, pair), strict=True))


def _numbers(errors: PoseErrors) -> tuple[ndarray, ndarray, ndarray]:
    return errors.t_us.numpy(), errors.rotation_deg.numpy(), errors.translation_cm.numpy()


def _standard_errors(first: Sequence[Arm], other: Sequence[Arm], held_us: Mapping[Track, Int[ndarray, "h"]], limits: Limits) -> Figures:
    """Of the change from the first method to the other, from how it differs between tracks."""
    changes = []
    for track, times in held_us.items():
        with_all, without = ([_figures(arm, {track: times}, limits) for arm in arms] for arms in (first, other))
        changes.append(Comparison([], with_all, without).change)
    columns = [[value for value in values if math.isfinite(value)] for values in zip(*changes, strict=True)]
    return Figures(*(math.sqrt(_variance(values) / max(len(values), 1)) for values in columns))


def _held_us(errors: PoseErrors, limits: Limits) -> Int[ndarray, "h"]:
    """Times of the windows that are not lost."""
    return errors.t_us.numpy()[~is_lost(errors, *limits)]


def _figures(arm: Arm, held_us: Mapping[Track, Int[ndarray, "h"]], limits: Limits) -> Figures:
    """The figures of a run; errors over those windows alone that are given of each track."""
    rotations, translations = [], []
    for track, times in held_us.items():
        errors = arm[track].errors
        counts = np.isin(errors.t_us.numpy(), times)
        if counts.any():
            rotations.append(float(errors.rotation_deg.numpy()[counts].mean()))
            translations.append(10 * float(errors.translation_cm.numpy()[counts].mean()))
    lost = [float(is_lost(arm[track].errors, *limits).mean()) for track in held_us]
    return Figures(_mean(rotations), _mean(translations), _mean(lost))


def _mean(values: Sequence[float]) -> float:
    return fmean(values) if values else math.nan


def pooled_spread(comparisons: Sequence[Comparison]) -> Figures | None:
    """Standard deviation between runs of one method, from all methods together; None where none ran twice."""
    repeated = [list(zip(*entry.without, strict=True)) for entry in comparisons if len(entry.without) > 1]
    if not repeated:
        return None
    return Figures(*(math.sqrt(_mean([variance(figures[number]) for figures in repeated])) for number in range(3)))


def verdict(entry: Comparison, spread: Figures | None) -> str:
    """Whether what the method leaves out is worth anything: without it, is any figure worse, by more than chance, and is none better?"""
    if spread is None or min(len(entry.with_all), len(entry.without)) < 2:
        return "one run"
    with_all, without = list(zip(*entry.with_all, strict=True)), list(zip(*entry.without, strict=True))
    least = (_LEAST_RELATIVE * fmean(with_all[0]), _LEAST_RELATIVE * fmean(with_all[1]), _LEAST_LOST)
    worse = better = False
    for number, change in enumerate(entry.change):
        of_mean = sum(max(_variance(values[number]), spread[number] ** 2) / len(values[number]) for values in (with_all, without))
        counts_from = max(_SIGMAS * math.sqrt(of_mean), _SIGMAS * entry.over_tracks[number], least[number])
        worse, better = worse or change > counts_from, better or change < -counts_from
    if worse and better:
        return "mixed"
    return "gains" if worse else "worse when present" if better else "within spread"


def _variance(values: Sequence[float]) -> float:
    return variance(values) if len(values) > 1 else 0.0


def _grid(comparisons: Mapping[str, Comparison], spread: Figures | None, methods: int, failed: set[str]) -> Grid:
    names = ("left out", "runs", "δR (°)", "δT (mm)", "lost (%)", "change δR", "change δT", "change lost", "differ", "verdict")
    rows = tuple(_row(method, entry, spread, first=number == 0) for number, (method, entry) in enumerate(comparisons.items()))
    notes = [_NOTE]
    if spread is not None:
        notes.append(f"Between runs of one method: {spread.rotation_deg:.4f}°, {spread.translation_mm:.3f} mm, {100 * spread.lost:.2f} % lost.")
    if len(comparisons) < methods:
        notes.append(f"{methods - len(comparisons)} of {methods} methods are not measured yet.")
    if failed:
        notes.append(f"Without {', '.join(sorted(failed))}, which failed.")
    return Grid("What each component is worth", (tuple(map(Cell, names)),), rows, tuple(notes))


def _row(method: str, entry: Comparison, spread: Figures | None, *, first: bool) -> tuple[Cell, ...]:
    rotation, translation, lost = zip(*entry.own, strict=True)
    texts = [
        *(method, str(len(entry.own))),
        *(_with_spread(rotation, 3), _with_spread(translation, 2), _with_spread([100 * share for share in lost], 2)),
    ]
    if first:
        return tuple(map(Cell, [*texts, "", "", "", "", ""]))
    change = entry.change
    worth = verdict(entry, spread)
    texts += [f"{change.rotation_deg:+.3f}", f"{change.translation_mm:+.2f}", f"{100 * change.lost:+.2f}", str(entry.differing), worth]
    return tuple(Cell(text, bold=text == worth == "gains") for text in texts)


def _with_spread(values: Sequence[float], digits: int) -> str:
    deviation = f" ± {math.sqrt(variance(values)):.{digits}f}" if len(values) > 1 else ""
    return f"{fmean(values):.{digits}f}{deviation}"


def _by_kind(arms: Mapping[str, Sequence[Arm]], limits: Limits) -> Grid:
    """Lost windows of each method on each kind of scene."""
    kinds = list(dict.fromkeys(_kind(sequence) for runs in arms.values() for sequence, _ in runs[0]))
    rows = tuple((Cell(method), *(Cell(f"{100 * _lost_of(runs, kind, limits):.1f}") for kind in kinds)) for method, runs in arms.items())
    return Grid("Windows lost by kind of scene (%)", (tuple(map(Cell, ("left out", *kinds))),), rows)


def _kind(sequence: str) -> str:
    return sequence.partition("_")[0]


def _lost_of(runs: Sequence[Arm], kind: str, limits: Limits) -> float:
    return _mean([float(is_lost(result.errors, *limits).mean()) for arm in runs for (name, _), result in arm.items() if _kind(name) == kind])

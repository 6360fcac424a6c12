"""What components are worth, made of results that are known."""

import math

import pytest
import torch

from torchtrack.eval.grid import headings
from torchtrack.eval.results import Evaluation, Failure, ObjectResult
from torchtrack.eval.trial import Comparison, Figures, compared, complete_arms, pooled_spread, trial_report, verdict
from torchtrack.run.metrics import PoseErrors, summarise

LIMITS = (10.0, 5.0)


def result(method, run, rotation_deg, sequence="far_cube", translation_cm=0.5):
    """Errors of windows of 5 ms with the given rotations."""
    rotation = torch.tensor(rotation_deg, dtype=torch.float64)
    errors = PoseErrors(5000 * torch.arange(1, len(rotation) + 1), rotation, torch.full_like(rotation, translation_cm))
    return ObjectResult(sequence, "cube", method, errors, summarise(errors, *LIMITS), {"TRACKING": len(rotation)}, 10.0, run=run)


def runs(method, *rotations, sequence="far_cube"):
    return [result(method, number, rotation, sequence) for number, rotation in enumerate(rotations, 1)]


def report(results, methods, sequences=("far_cube",), failures=()):
    return trial_report(Evaluation(tuple(results), (), tuple(failures)), methods, sequences, LIMITS)


def rows(grid):
    """Label of each row to its entries by heading."""
    names = headings(grid)[1:]
    return {row[0].text: dict(zip(names, (cell.text for cell in row[1:]), strict=True)) for row in grid.rows}


def test_errors_are_of_windows_that_are_held_and_lost_ones_are_counted():
    table = rows(report([*runs("all", [1, 1, 3, 3]), *runs("less", [1, 1, 90, 2])], ("all", "less")).grids[0])
    assert (table["all"]["δR (°)"], table["all"]["δT (mm)"], table["all"]["lost (%)"]) == ("2.000", "5.00", "0.00")
    assert (table["less"]["δR (°)"], table["less"]["lost (%)"]) == ("1.333", "25.00")
    # On the three windows that both hold, the first errs by 5/3 and the second by 4/3.
    assert (table["less"]["change δR"], table["less"]["change lost"]) == ("-0.333", "+25.00")
    assert (table["all"]["change δR"], table["all"]["verdict"]) == ("", "")
    assert table["less"]["verdict"] == "one run"


def test_figures_are_means_over_tracks():
    results = [*runs("all", [1, 1]), *runs("all", [3, 3, 3, 90], sequence="dim_cube")]
    (own,) = compared(*[complete_arms(results, ["far_cube", "dim_cube"])["all"]] * 2, LIMITS).own
    assert own == Figures(2.0, 5.0, 0.125)


def test_a_track_that_is_lost_from_the_start_has_no_errors_but_counts_as_lost():
    table = rows(report(runs("all", [90, 90]), ("all",)).grids[0])
    assert (table["all"]["δR (°)"], table["all"]["lost (%)"]) == ("nan", "100.00")


@pytest.mark.parametrize(
    ("without", "expected"),
    [
        ([[2.0], [2.1], [1.9]], "gains"),
        ([[0.5], [0.6], [0.4]], "worse when present"),
        ([[1.0], [1.15], [0.9]], "within spread"),
        # Larger than what differs between runs, but less than 1 % of the error.
        ([[1.009], [1.009], [1.009]], "within spread"),
    ],
)
def test_a_change_counts_if_it_is_larger_than_what_runs_differ_by(without, expected):
    entry = compared(*complete_arms([*runs("all", [1.0], [1.1], [0.9]), *runs("less", *without)], ["far_cube"]).values(), LIMITS)
    still = Figures(0.0, 0.0, 0.0)
    assert verdict(entry, still if expected == "within spread" and without[0] == [1.009] else pooled_spread([entry])) == expected


def test_what_gains_in_one_figure_and_costs_in_another_is_mixed():
    entry = Comparison([], [Figures(1.0, 5.0, 0.1)] * 2, [Figures(2.0, 5.0, 0.0)] * 2)
    assert verdict(entry, Figures(0.01, 0.01, 0.01)) == "mixed"
    assert verdict(Comparison([], entry.with_all, [Figures(2.0, 5.0, 0.1)] * 2), Figures(0.01, 0.01, 0.01)) == "gains"


def test_a_small_change_of_the_lost_share_does_not_count():
    entry = Comparison([], [Figures(1.0, 5.0, 0.1)] * 2, [Figures(1.0, 5.0, 0.1005)] * 2)
    assert verdict(entry, Figures(0.0, 0.0, 0.0)) == "within spread"


def test_the_spread_is_that_of_all_methods_together():
    steady, loose = ([Figures(x, 0.0, 0.0) for x in values] for values in ([1.0, 1.0], [1.0, 2.0]))
    entries = [Comparison([], [], steady), Comparison([], [], loose), Comparison([], [], steady[:1])]
    assert pooled_spread(entries) == Figures(pytest.approx(math.sqrt(0.5 / 2)), 0.0, 0.0)
    assert pooled_spread(entries[2:]) is None


@pytest.mark.parametrize(("changed", "expected"), [(1, "within spread"), (10, "gains")])
def test_a_change_on_one_track_of_many_is_chance(changed, expected):
    names = [f"far_{number}" for number in range(10)]
    results = [entry for name in names for entry in runs("all", [1.0], [1.0], sequence=name)]
    results += [entry for number, name in enumerate(names) for entry in runs("less", *2 * [[90.0 if number < changed else 1.0]], sequence=name)]
    table = rows(report(results, ("all", "less"), names).grids[0])
    assert (table["less"]["change lost"], table["less"]["verdict"]) == (f"+{10 * changed:.2f}", expected)


def test_a_method_that_ran_once_is_not_judged():
    results = [*runs("all", [1.0], [1.1], [0.9]), *runs("less", [3.0])]
    table = rows(report(results, ("all", "less")).grids[0])
    assert (table["less"]["runs"], table["less"]["change δR"], table["less"]["verdict"]) == ("1", "+2.000", "one run")
    assert table["all"]["δR (°)"] == "1.000 ± 0.100"


@pytest.mark.parametrize(
    ("without", "expected"),
    [([[1.0, 2.0], [3.0, math.nan]], "0"), ([[1.0, 2.0 + 1e-12]], "1"), ([[1.0, 2.0, 2.0]], "1"), ([[1.0, 2.0], [3.0, 4.0]], "1")],
)
def test_it_is_told_on_how_many_tracks_anything_differs_from_the_same_start(without, expected):
    others = [*runs("all", [1.0, 2.0], [3.0, math.nan], sequence="dim_cube"), *runs("less", [1.0, 2.0], [3.0, math.nan], sequence="dim_cube")]
    results = [*runs("all", [1.0, 2.0], [3.0, math.nan]), *runs("less", *without), *others]
    # A run that is not complete is left out, and so are those of its number.
    results = [entry for entry in results if entry.method == "all" or entry.run <= len(without)]
    table = rows(report(results, ("all", "less"), ("far_cube", "dim_cube")).grids[0])
    assert (table["all"]["differ"], table["less"]["differ"]) == ("", expected)


def test_runs_that_are_not_complete_and_sequences_that_failed_are_left_out():
    results = [*runs("all", [1.0], [1.0]), *runs("less", [2.0], [2.0]), *runs("all", [1.0], sequence="dim_cube")]
    both = ("far_cube", "dim_cube")
    grid = report(results, ("all", "less"), both).grids[0]
    assert {method: row["runs"] for method, row in rows(grid).items()} == {"all": "1"}
    assert "1 of 2 methods are not measured yet." in grid.notes
    grid = report(results, ("all", "less"), both, [Failure("dim_cube", "less", "broken")]).grids[0]
    assert {method: row["runs"] for method, row in rows(grid).items()} == {"all": "2", "less": "2"}
    assert grid.notes[-1] == "Without dim_cube, which failed."
    assert rows(report([], ("all", "less"), both).grids[0]) == {}


def test_lost_windows_are_also_told_by_kind_of_scene():
    results = [*runs("all", [1, 90]), *runs("all", [1, 1], sequence="far_duck"), *runs("all", [90, 90], sequence="dim_cube")]
    grid = report(results, ("all",), ("far_cube", "far_duck", "dim_cube")).grids[1]
    assert rows(grid) == {"all": {"far": "25.0", "dim": "100.0"}}

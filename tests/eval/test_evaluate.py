import csv
import json
import math

import pytest
import torch
import trimesh
from elsewhere import Elsewhere
from helpers import random_pose
from pydantic import ValidationError
from tiny_sequence import write_tiny_sequence

from torchtrack.config.evaluate import EvaluateConfig, MethodConfig
from torchtrack.core.lie import se3_interpolate, so3_exp
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.eval.evaluate import evaluate, measure
from torchtrack.eval.sources import find_sequences
from torchtrack.eval.tables import results_table
from torchtrack.io import Trajectory
from torchtrack.io.convert import convert
from torchtrack.run.metrics import PoseErrors, pose_errors, summarise
from torchtrack.run.sinks.summary import finite

KEYS = (
    *("sequence", "object", "method", "windows", "mean_rotation_deg", "mean_translation_cm", "median_rotation_deg"),
    *("median_translation_cm", "max_rotation_deg", "max_translation_cm", "lost_fraction"),
)


def turned(T, degrees):
    """The pose with its rotation changed by an angle, and its position by 3 cm and 4 cm."""
    result = T.clone()
    result[..., :3, :3] = T[..., :3, :3] @ so3_exp(torch.deg2rad(torch.tensor([0.0, degrees, 0.0], dtype=torch.float64)))
    result[..., :3, 3] += torch.tensor([0.03, 0.0, 0.04])
    return result


def test_errors_of_known_poses():
    t_us = torch.arange(5) * 1000
    T = random_pose(5)
    errors = pose_errors(t_us, turned(T, 2.5), Trajectory(t_us, T))
    assert torch.allclose(errors.rotation_deg, torch.full((5,), 2.5, dtype=torch.float64))
    assert torch.allclose(errors.translation_cm, torch.full((5,), 5.0, dtype=torch.float64))


def test_truth_is_interpolated_at_the_time_of_the_pose():
    start, end = random_pose(2)
    truth = Trajectory(torch.tensor([0, 1000]), torch.stack([start, end]))
    between = se3_interpolate(start, end, torch.tensor(0.3, dtype=torch.float64))
    errors = pose_errors(torch.tensor([300]), between[None], truth)
    assert errors.rotation_deg.item() == pytest.approx(0, abs=1e-6)
    assert errors.translation_cm.item() == pytest.approx(0, abs=1e-6)


def test_times_without_truth_are_left_out():
    truth = Trajectory(torch.tensor([1000, 2000]), random_pose(2))
    errors = pose_errors(torch.tensor([999, 1000, 2000, 2001]), random_pose(4), truth)
    assert errors.t_us.tolist() == [1000, 2000]


def errors_of(rotation, translation):
    return PoseErrors(torch.arange(len(rotation)), torch.tensor(rotation, dtype=torch.float64), torch.tensor(translation, dtype=torch.float64))


def test_summary_of_errors():
    metrics = summarise(errors_of([1.0, 2.0, 12.0, 3.0], [1.0, 9.0, 8.0, 2.0]))
    assert (metrics.windows, metrics.mean_rotation_deg, metrics.median_rotation_deg, metrics.max_rotation_deg) == (4, 4.5, 2.5, 12.0)
    assert (metrics.mean_translation_cm, metrics.median_translation_cm, metrics.max_translation_cm) == (5.0, 5.0, 9.0)
    # One window is off in translation alone, one in both.
    assert metrics.lost_fraction == 0.5
    assert summarise(errors_of([1.0, 2.0, 12.0, 3.0], [1.0, 9.0, 8.0, 2.0]), 20.0, 8.5).lost_fraction == 0.25


def test_a_pose_that_is_not_finite_is_lost():
    assert summarise(errors_of([1.0, float("nan")], [1.0, float("nan")])).lost_fraction == 0.5


def test_peak_is_the_largest_settled_error_by_the_mean():
    errors = PoseErrors(
        torch.tensor([0, 20_000, 50_000, 60_000]),
        torch.tensor([9.0, 1.0, 4.0, 2.0], dtype=torch.float64),
        torch.tensor([1.0, 1.0, 1.0, 5.0], dtype=torch.float64),
    )
    metrics = summarise(errors)
    assert (metrics.peak_rotation, metrics.peak_translation) == (1.0, 2.5)
    # A sequence that ends before, or without any error, has none.
    assert math.isnan(summarise(errors_of([1.0, 2.0], [1.0, 2.0])).peak_rotation)
    assert math.isnan(summarise(PoseErrors(errors.t_us, torch.zeros(4).double(), torch.zeros(4).double())).peak_rotation)


def test_summary_of_nothing():
    metrics = summarise(errors_of([], []))
    assert metrics.windows == 0
    assert math.isnan(metrics.mean_rotation_deg)


def test_evaluate_measures_every_sequence_object_and_method(folder, tmp_path):
    methods = {"default": {}, "short": {"tracker": {"window": {"duration_us": 2500}}}}
    done = []
    evaluation = evaluate(EvaluateConfig(paths=(folder,), methods=methods, jobs=1, output=tmp_path / "out"), done.append)
    entries = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [(entry["sequence"], entry["object"], entry["method"]) for entry in entries] == [
        *[("one", "box", "default"), ("one", "box", "short")],
        *[("two", "left", "default"), ("two", "right", "default"), ("two", "left", "short"), ("two", "right", "short")],
    ]
    assert all(set(KEYS) <= set(entry) for entry in entries)
    # Truth starts at 0, the first event comes at 500 µs, and so does the first window.
    assert [entry["windows"] for entry in entries] == [5, 11, 3, 3, 7, 7]
    assert all(entry["lost_fraction"] == 0 and entry["max_rotation_deg"] < 2 for entry in entries)
    rows = list(csv.DictReader((tmp_path / "out" / "errors.csv").read_text().splitlines()))
    assert len(rows) == sum(entry["windows"] for entry in entries)
    assert len(done) == 4
    assert all(sum(entry["status"].values()) >= entry["windows"] for entry in entries)
    assert results_table(evaluation).row_count == 6


def test_a_sequence_that_fails_is_reported_and_the_rest_completes(folder, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    config = EvaluateConfig(paths=(tmp_path / "bad.npz", folder / "two.npz"), jobs=1, output=tmp_path / "out")
    evaluation = evaluate(config)
    assert [(failure.sequence, failure.method) for failure in evaluation.failures] == [("bad", "default")]
    assert "bad.npz" in evaluation.failures[0].reason
    assert [result.object for result in evaluation.results] == ["left", "right"]
    assert len(json.loads((tmp_path / "out" / "metrics.json").read_text())) == 2


def test_processes_give_the_same_as_one(folder, tmp_path, monkeypatch):
    """What stands in for processes, all but that they are new; an evaluation in new ones is in ``tests/cli/test_many.py``."""
    elsewhere = Elsewhere()
    monkeypatch.setattr("torchtrack.run.executor.run_in_processes", elsewhere)
    alone = evaluate(EvaluateConfig(paths=(folder,), jobs=1, output=tmp_path / "alone"))
    shared = evaluate(EvaluateConfig(paths=(folder,), jobs=2, output=tmp_path / "shared"))
    assert elsewhere.jobs == [2]
    # Peaks of a sequence this short are not known, and so not equal to themselves.
    assert [finite(result.metrics.as_dict()) for result in alone.results] == [finite(result.metrics.as_dict()) for result in shared.results]


def write_ball_and_box(folder):
    """A sequence of a curved and a straight object."""
    path = write_tiny_sequence(folder, "mixed", labels=("ball", "box"), duration_us=20_000)
    trimesh.creation.icosphere(subdivisions=3, radius=0.06).export(folder / "mixed_ball.ply")
    return path


# ---- taken up again


METHODS = {"default": {}, "line": {"preset": "line"}}


def broken_off(paths, tmp_path, after):
    """The configuration of an evaluation that was interrupted after so many sequences."""
    config = EvaluateConfig(paths=paths, methods=METHODS, jobs=1, output=tmp_path / "out")
    done = []

    def interrupt(job):
        done.append(job)
        if len(done) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(config, interrupt)
    return config


def measured_by(monkeypatch):
    """Names and methods of the sequences that are really tracked from now on."""
    tracked = []

    def watched(jobs, tell, limits):
        tracked.extend((job.path.stem, job.method) for job in jobs)
        return measure(jobs, tell, limits)

    monkeypatch.setattr("torchtrack.eval.evaluate.measure", watched)
    return tracked


def figures(evaluation):
    """All that was measured but the times."""
    rows = [[entry.sequence, entry.object, entry.method, finite(entry.metrics.as_dict()), entry.status] for entry in evaluation.results]
    return rows, [entry.as_json() for entry in evaluation.not_applicable], [entry.errors.rotation_deg.tolist() for entry in evaluation.results]


def test_an_evaluation_that_was_broken_off_is_taken_up_again(folder, tmp_path, monkeypatch):
    (tmp_path / "mixed").mkdir()
    config = broken_off((folder, write_ball_and_box(tmp_path / "mixed")), tmp_path, 3)
    tracked, done = measured_by(monkeypatch), []
    resumed = evaluate(config.model_copy(update={"resume": True}), done.append)
    assert len(tracked) == 3 and len(done) == 6
    anew = evaluate(config.model_copy(update={"output": tmp_path / "anew"}))
    assert len(tracked) == 9
    assert figures(resumed) == figures(anew)
    assert (tmp_path / "out" / "errors.csv").read_text() == (tmp_path / "anew" / "errors.csv").read_text()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["errors.csv", "metrics.json"]


def test_all_is_measured_anew_unless_it_is_to_be_resumed(folder, tmp_path, monkeypatch):
    config = broken_off((folder,), tmp_path, 3)
    tracked = measured_by(monkeypatch)
    evaluate(config)
    assert len(tracked) == 4


def test_what_was_measured_otherwise_or_not_to_the_end_is_measured_anew(folder, tmp_path, monkeypatch):
    config = broken_off((folder,), tmp_path, 3).model_copy(update={"resume": True})
    journal = tmp_path / "out" / "outcomes.jsonl"
    journal.write_text(journal.read_text()[:-20])
    tracked = measured_by(monkeypatch)
    slower = MethodConfig.model_validate({"preset": "line", "tracker": {"window": {"duration_us": 2500}}})
    evaluate(config.model_copy(update={"methods": {**config.methods, "line": slower}}))
    assert tracked == [("one", "line"), ("two", "default"), ("two", "line")]


def test_what_counts_as_lost_may_change_before_it_is_resumed(folder, tmp_path, monkeypatch):
    config = broken_off((folder,), tmp_path, 3).model_copy(update={"resume": True, "lost_rotation_deg": 1e-9})
    tracked = measured_by(monkeypatch)
    resumed = evaluate(config)
    assert len(tracked) == 1
    assert all(result.metrics.lost_fraction == 1 for result in resumed.results)


@pytest.mark.parametrize("line", ["no json", "{}", '{"identity": "a"}', '{"identity": "a", "measured": [{}]}', "[1]", "\x00"])
def test_a_file_of_measurements_that_is_none_is_told_and_kept(folder, tmp_path, line):
    config = broken_off((folder,), tmp_path, 2).model_copy(update={"resume": True})
    journal = tmp_path / "out" / "outcomes.jsonl"
    spoilt = journal.read_text() + line + "\n"
    journal.write_text(spoilt)
    with pytest.raises(UnknownFormatError, match=r"line 3 of '.*outcomes\.jsonl' is not a measurement .*without --resume"):
        evaluate(config)
    assert journal.read_text() == spoilt


def test_what_failed_is_tried_again(folder, tmp_path, monkeypatch):
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"no archive")
    config = EvaluateConfig(paths=(bad, folder / "two.npz"), jobs=1, output=tmp_path / "out")
    assert len(evaluate(config).failures) == 1
    tracked = measured_by(monkeypatch)
    evaluation = evaluate(config.model_copy(update={"resume": True}))
    assert tracked == [("bad", "default")]
    assert len(evaluation.failures) == 1 and len(evaluation.results) == 2


def test_an_object_that_a_method_is_not_made_for_is_no_failure(tmp_path):
    methods = {"line": {"preset": "line"}, "default": {}}
    evaluation = evaluate(EvaluateConfig(paths=(write_ball_and_box(tmp_path),), methods=methods, jobs=1, output=tmp_path / "out"))
    assert not evaluation.failures
    assert [(result.object, result.method) for result in evaluation.results] == [("box", "line"), ("ball", "default"), ("box", "default")]
    ((entry),) = evaluation.not_applicable
    assert (entry.object, entry.method) == ("ball", "line") and "'ball' is curved" in entry.reason
    last = json.loads((tmp_path / "out" / "metrics.json").read_text())[-1]
    assert set(KEYS) <= set(last) and last["mean_rotation_deg"] is None and "curved" in last["not_applicable"]
    assert results_table(evaluation).row_count == 4


def test_a_compact_report_is_written(folder, tmp_path):
    methods = {"default": {}, "short": {"tracker": {"window": {"duration_us": 2500}}}}
    config = EvaluateConfig(paths=(folder / "two.npz",), methods=methods, jobs=1, report="compact", output=tmp_path / "out")
    evaluate(config)
    assert "| default |" in (tmp_path / "out" / "tables.md").read_text()
    assert len(json.loads((tmp_path / "out" / "tables.json").read_text())) == 4


def test_finding_sequences(folder, tmp_path):
    assert [path.name for path in find_sequences([folder, folder / "one.npz"])] == ["one.npz", "two.npz"]
    with pytest.raises(ConfigError, match="nothing to evaluate"):
        find_sequences([])
    with pytest.raises(MissingFileError, match="nowhere"):
        find_sequences([tmp_path / "nowhere"])
    with pytest.raises(MissingFileError, match="holds no sequence"):
        find_sequences([tmp_path])


def test_sequences_in_hdf5_are_found_in_a_folder_and_other_hdf5_is_not(folder, tmp_path):
    convert(folder / "one.npz", tmp_path / "one.h5")
    convert(folder / "one.npz", tmp_path / "events_alone.h5", "dsec")
    assert [path.name for path in find_sequences([tmp_path])] == ["one.h5"]


# ---- trials


LESS = {"all": {"preset": "causal"}, "less": {"joins": ["all"], "tracker": {"relocalization": {"hypotheses": 0}}}}


def trial(folder, tmp_path, **changes):
    marked = tmp_path / "results.md"
    marked.write_text("<!-- TRIAL -->\n<!-- /TRIAL -->\n")
    settings = {"paths": (folder,), "methods": LESS, "jobs": 1, "report": "trial", "table": marked, "output": tmp_path / "out"}
    return EvaluateConfig.model_validate({**settings, **changes})


def test_a_trial_goes_on_with_more_runs_and_tells_what_it_has_so_far(folder, tmp_path, monkeypatch):
    done = []
    first = evaluate(trial(folder, tmp_path), done.append)
    # One run of a method after the other.
    assert [(job.method, job.path.stem, job.start.run) for job in done] == [
        *[("all", "one", 1), ("all", "two", 1)],
        *[("less", "one", 1), ("less", "two", 1)],
    ]
    assert "| less" in (tmp_path / "results.md").read_text() and "one run" in (tmp_path / "results.md").read_text()
    tracked = measured_by(monkeypatch)
    second = evaluate(trial(folder, tmp_path, runs=2, resume=True))
    assert tracked == [("one", "all"), ("two", "all"), ("one", "less"), ("two", "less")]
    assert [result.run for result in second.results] == 6 * [1] + 6 * [2]
    assert figures(first)[0] == figures(second)[0][:6]
    by_run = [[result.errors.rotation_deg.tolist() for result in second.results if result.run == run] for run in (1, 2)]
    assert by_run[0] != by_run[1]
    tracked.clear()
    so_far = evaluate(trial(folder, tmp_path, runs=3, measured_only=True))
    assert figures(so_far) == figures(second) and not tracked
    assert max(len(line) for line in (tmp_path / "results.md").read_text().splitlines() if not line.startswith("|")) <= 120


def test_a_start_that_is_off_is_another_measurement(folder, tmp_path, monkeypatch):
    straight = evaluate(trial(folder, tmp_path))
    tracked = measured_by(monkeypatch)
    turned = evaluate(trial(folder, tmp_path, resume=True, start_angles_deg={"tw*": 8}))
    assert tracked == [("two", "all"), ("two", "less")]
    before, after = ([float(result.errors.rotation_deg[0]) for result in entry.results if result.method == "less"] for entry in (straight, turned))
    assert after[0] == before[0] and after[1] > before[1] + 0.1 and after[2] > before[2] + 0.1


def test_what_does_not_fit_a_trial_is_told_before_anything_is_measured(folder, tmp_path):
    with pytest.raises(ValidationError, match="runs and table are of report: trial"):
        EvaluateConfig(paths=(folder,), runs=2)
    config = trial(folder, tmp_path)
    (tmp_path / "results.md").write_text("no marks")
    with pytest.raises(ConfigError, match="needs the lines '<!-- TRIAL -->'"):
        evaluate(config)
    assert not (tmp_path / "out").exists()


def test_methods_are_joined_in_the_order_of_their_names():
    methods = EvaluateConfig.model_validate(
        {
            "methods": {
                "both": {"joins": ["short", "inner"], "tracker": {"window": {"count": 99}}},
                "short": {"preset": "causal", "tracker": {"window": {"duration_us": 2500, "mode": "count"}}},
                "longer": {"tracker": {"window": {"duration_us": 4000}}},
                "inner": {"joins": ["longer"]},
            }
        }
    ).methods
    window = methods["both"].tracker.window
    assert (methods["both"].preset, window.duration_us, window.mode, window.count) == ("causal", 4000, "count", 99)
    assert methods["inner"] == methods["longer"]


def test_methods_that_are_joined_leave_out_what_each_of_them_does():
    each = {name: {"preset": "causal", "tracker": {"disabled": [name]}} for name in ("line_ends", "drift")}
    both = {"joins": [*each], "tracker": {"disabled": ["around_last_seen"]}}
    methods = EvaluateConfig.model_validate({"methods": {"both": both, **each}}).methods
    assert methods["both"].tracker.disabled == {"line_ends", "drift", "around_last_seen"}
    assert methods["drift"].tracker.disabled == {"drift"}


@pytest.mark.parametrize(
    ("joins", "message"),
    [
        ("other", "give a list of labels"),
        ([], "give a list"),
        (["nowhere"], "nowhere is no other method; there are all, other"),
        (["all"], "all is no"),
    ],
)
def test_methods_that_cannot_be_joined_are_told(joins, message):
    with pytest.raises(ValidationError, match=rf"methods\.all\.joins: {message}"):
        EvaluateConfig.model_validate({"methods": {"all": {"joins": joins}, "other": {}}})

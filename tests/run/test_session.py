"""Where tracking starts and ends, and what becomes of clocks that jump, in whole runs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from tiny_sequence import write_tiny_sequence

from torchtrack.config.run import RunConfig
from torchtrack.errors import ConfigError, EventDataError, TorchtrackWarning
from torchtrack.io import read_sequence
from torchtrack.object_model import ObjectModel
from torchtrack.run.runner import run
from torchtrack.run.session import open_session


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=40_000)


def quick(sequence_path, output, **settings):
    """A run without an overlay."""
    return RunConfig(**{"source": sequence_path, "output": output, "overlay": {"enabled": False}, **settings})


def with_times(path, folder, change) -> Path:
    """The same sequence with other times of its events."""
    with np.load(path) as arrays:
        content = dict(arrays)
    content["t"] = change(content["t"])
    shutil.copyfile(path.with_name("tiny_box.ply"), folder / "tiny_box.ply")
    np.savez(folder / "changed.npz", **content)
    return folder / "changed.npz"


def test_a_start_on_another_clock_is_refused_with_the_time_of_the_first_event(sequence_path, tmp_path):
    changed = with_times(sequence_path, tmp_path, lambda t: t + 1_700_000_000_000_000)
    for settings in ({}, {"tracker": {"window": {"mode": "count"}}}):
        with pytest.raises(ConfigError, match=r"the first event of '.*' after that is at 1700000000000500 µs, .* different clocks"):
            run(quick(changed, tmp_path / "out", start_us=0, **settings))


def test_a_start_some_time_before_the_first_event_is_told(sequence_path, tmp_path):
    changed = with_times(sequence_path, tmp_path, lambda t: t + 3_000_000)
    with pytest.warns(TorchtrackWarning, match=r"the first event of .* is at 3000500 µs, 3\.0 s later"):
        summary = run(quick(changed, tmp_path / "out", start_us=0))
    assert summary.duration_s < 0.6
    assert (summary.gap_count, summary.gaps[0].start_us, summary.gaps[0].duration_us) == (1, 0, 3_000_500)


def test_an_end_before_the_first_event_is_told_with_its_time(sequence_path, tmp_path):
    with pytest.raises(EventDataError, match=r"no events up to 100 µs to track with\. Its first event is at 500 µs"):
        run(quick(sequence_path, tmp_path / "out", end_us=100))


@pytest.mark.parametrize("mode", ["time", "count"])
def test_an_hour_without_events_costs_no_windows(sequence_path, tmp_path, mode):
    changed = with_times(sequence_path, tmp_path, lambda t: np.where(t > 20_000, t + 3_600_000_000, t))
    window = {"mode": mode, "duration_us": 5000, "count": 200}
    summary = run(quick(changed, tmp_path / "out", tracker={"window": window}))
    assert summary.windows < 130
    assert summary.duration_s < 0.6
    assert summary.gaps[0].duration_us > 3_599_000_000
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["gap_count"] == 1


def test_a_clock_that_jumps_back_is_tracked_on_and_told(sequence_path, tmp_path):
    expected = run(quick(sequence_path, tmp_path / "expected"))
    changed = with_times(sequence_path, tmp_path, lambda t: np.where(t > 20_000, t - 1_000_000_000, t))
    with pytest.warns(TorchtrackWarning, match="jumps back of the clock"):
        summary = run(quick(changed, tmp_path / "out"))
    assert summary.windows == expected.windows
    assert summary.problems == {"jumps back of the clock, taken out": 1}
    changes = json.loads((tmp_path / "out" / "summary.json").read_text())["clock_changes"]
    assert changes == [{"kind": "reset", "at_us": 20_001, "from_us": 20_000, "to_us": -999_979_500}]


def test_a_model_is_placed_by_its_settings_and_a_sequences_own_is_not(sequence_path):
    mesh = next(sequence_path.parent.glob("*.ply"))
    label = read_sequence(sequence_path).objects[0].label
    pose = {"translation_m": (0, 0, 0.5)}
    placed = {"label": "other", "mesh": mesh, "unit": "cm", "scale": 200.0, "centre": True, "initial_pose": pose}
    session = open_session(RunConfig(source=sequence_path, objects=[placed]))
    assert session.models[0].diameter_m == pytest.approx(2 * ObjectModel.from_file(mesh).diameter_m)
    assert session.models[0].centre.abs().max() < 1e-6
    with pytest.raises(ConfigError, match=r"centre: '.*' knows poses of .* Leave centre out"):
        open_session(RunConfig(source=sequence_path, objects=[{**placed, "label": label}]))
    with pytest.raises(ValidationError, match="unit, scale and centre are of a mesh or polylines given here"):
        RunConfig(source=sequence_path, objects=[{"label": label, "centre": True}])

"""Bars on a terminal: what takes its time says how far it is, on standard error, and not where nobody looks or wants it."""

import gc

import cv2
import numpy as np
import pytest
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.cli.progress import progress_shown, share_of


@pytest.fixture
def terminal(monkeypatch):
    """Rich takes standard error for a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=40_000)


def commands(sequence_path, folder):
    """Arguments of each command that shows a bar, and a text of the bar."""
    (folder / "images").mkdir(parents=True)
    for number in range(3):
        image = np.full((40, 60), 50, np.uint8)
        cv2.circle(image, (20 + 4 * number, 20), 8, 200, -1)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), image)
    video = ["simulate", "--video", str(folder / "images"), "--fps", "100", "-o", str(folder / "video.npz")]
    track = ["track", str(sequence_path), "-o", str(folder / "out"), "--overlay.enabled", "false", "--preset", "causal"]
    return [
        (["info", str(sequence_path)], "reading tiny.npz"),
        (["convert", str(sequence_path), str(folder / "events.csv")], "converting tiny.npz"),
        (video, "events of images"),
        (track, "x real time"),
    ]


def test_what_takes_time_says_how_far_it_is(sequence_path, tmp_path, terminal, capsys):
    for arguments, shown in commands(sequence_path, tmp_path):
        assert main(arguments) == ExitCode.DONE
        text = capsys.readouterr().err
        assert shown in text and "%" in text, arguments


def test_it_is_quiet_on_demand_and_where_there_is_no_terminal(sequence_path, tmp_path, monkeypatch, capsys):
    for arguments, _ in commands(sequence_path, tmp_path):
        assert main(arguments) == ExitCode.DONE
        assert capsys.readouterr().err == "", arguments
    monkeypatch.setenv("FORCE_COLOR", "1")
    for arguments, _ in commands(sequence_path, tmp_path / "again"):
        assert main([*arguments, "--quiet"]) == ExitCode.DONE
        assert capsys.readouterr().err == "", arguments


def test_kernels_that_are_compiled_are_a_task_of_their_own(terminal, capsys):
    numba = pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")

    def added(a, b):
        return a + b

    def multiplied(a, b):
        return a * b

    added.__module__ = multiplied.__module__ = "torchtrack.backends.numba.invented"
    with progress_shown() as progress:
        share_of(progress, "work")(0.5)
        assert numba.njit(added)(1, 2) == 3
    assert "compiling kernels (about 40 s, once)" in capsys.readouterr().err
    with progress_shown(quiet=True):
        assert numba.njit(multiplied)(3, 2) == 6
    # Afterwards nobody listens any more.
    assert numba.njit(multiplied)(1.0, 2) == 2.0
    assert capsys.readouterr().err == ""


def test_names_are_no_markup(terminal, capsys):
    with progress_shown(kernels=False) as progress:
        share_of(progress, "reading [red]a.npz")(1.0)
    assert "[red]a.npz" in capsys.readouterr().err


def test_the_garbage_collector_is_as_it_was_after_a_command(capsys):
    before = gc.get_threshold()
    assert main(["settings", "track"]) == ExitCode.DONE
    assert gc.get_threshold() == before and gc.isenabled()
    assert capsys.readouterr().out

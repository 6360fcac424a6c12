"""How the command line ends when the world outside is not as it should be."""

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPOSITORY
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.io import read_tum
from torchtrack.run.sinks.folder import ended


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=40_000)


def track(sequence_path, out, *more):
    return main(["track", str(sequence_path), "-o", str(out), "--overlay.enabled", "false", "--preset", "causal", *more])


class AtThird:
    """In place of the progress bar: does something at the third step."""

    def __init__(self, what):
        self._what, self._count = what, 0

    def add(self, step):
        self._count += 1
        if self._count == 3:
            self._what()

    def close(self):
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_keeps_its_results_and_goes_on(sequence_path, tmp_path, monkeypatch, capsys, number):
    monkeypatch.setattr("torchtrack.cli.track.ProgressBar", lambda *about: AtThird(lambda: os.kill(os.getpid(), number)))
    handler = signal.getsignal(number)
    assert track(sequence_path, tmp_path / "out") == ExitCode.INTERRUPTED
    assert signal.getsignal(number) is handler
    assert len(read_tum(tmp_path / "out" / "trajectory_box.tum")) == 3
    assert "Results are in" in capsys.readouterr().out
    assert track(sequence_path, tmp_path / "out", "--resume", "--quiet") == ExitCode.DONE
    assert len(read_tum(tmp_path / "out" / "trajectory_box.tum")) == 8
    assert track(sequence_path, tmp_path / "out", "--resume", "--quiet") == ExitCode.WRONG_SETTINGS
    assert "is complete" in capsys.readouterr().err


def test_a_signal_outside_a_run_ends_in_good_order(tmp_path, monkeypatch):
    def simulating(*about):
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("should not come here")

    monkeypatch.setattr("torchtrack.cli.files.convert", simulating)
    assert main(["convert", "a.npz", str(tmp_path / "b.npz")]) == ExitCode.INTERRUPTED


_KILLED = """
import os, signal, sys
from torchtrack.config.run import RunConfig
from torchtrack.run.runner import run
class Killing:
    count = 0
    def add(self, step):
        self.count += 1
        if self.count == 5:
            os.kill(os.getpid(), signal.SIGKILL)
    def close(self):
        pass
run(RunConfig(source=sys.argv[1], output=sys.argv[2], overlay={"enabled": False}, preset="causal"), [Killing()])
"""


def test_what_a_killed_run_has_written_can_be_read_and_taken_up(sequence_path, tmp_path):
    out = tmp_path / "out"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", _KILLED, str(sequence_path), str(out)], env=environment, check=False, timeout=200)
    assert done.returncode == -signal.SIGKILL
    assert len(read_tum(out / "trajectory_box.tum")) == 5
    assert ended(out) == "running"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert track(sequence_path, out, "--resume", "--quiet") == ExitCode.DONE
    assert len(read_tum(out / "trajectory_box.tum")) == 8
    assert sorted(path.name for path in out.iterdir()) == ["config.yaml", "first_window.png", "poses.csv", "summary.json", "trajectory_box.tum"]


def test_several_are_taken_up_together(folder, tmp_path, capsys):
    arguments = ["track", str(folder / "one.npz"), str(folder / "two.npz"), "-o", str(tmp_path / "out"), "--overlay.enabled", "false", "--quiet"]
    assert main(["track", str(folder / "one.npz"), "-o", str(tmp_path / "out" / "one"), "--overlay.enabled", "false", "--quiet"]) == ExitCode.DONE
    capsys.readouterr()
    assert main([*arguments, "--resume"]) == ExitCode.DONE
    assert "one.npz: complete already, left out" in capsys.readouterr().out
    assert [ended(tmp_path / "out" / name) for name in ("one", "two")] == ["completed", "completed"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["track", "{sequence}", "-o", "{file}", "--quiet"],
        ["track", "{sequence}", "-o", "{file}/below", "--quiet"],
        ["evaluate", "{sequence}", "-o", "{file}/below", "--quiet"],
        ["convert", "{sequence}", "{file}/below.h5"],
        ["convert", "{sequence}", "{sequence}"],
        ["convert", "{sequence}", "{folder}.h5"],
        ["simulate", "{scene}", "-o", "{file}/below.npz", "--quiet"],
        ["bench", "solver", "-o", "{file}/below"],
    ],
)
def test_an_output_that_cannot_be_is_one_line(sequence_path, tmp_path, capsys, arguments):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "scene.yaml").write_text(
        "name: a\ncamera: {width: 60, height: 40, fx: 60, fy: 60}\nduration_s: 0.02\nobjects: [{label: cube, shape: cube}]\n"
    )
    (tmp_path / "folder.h5").mkdir()
    before = sequence_path.read_bytes()
    named = {"sequence": sequence_path, "file": tmp_path / "file", "folder": tmp_path / "folder", "scene": tmp_path / "scene.yaml"}
    assert main([argument.format(**named) for argument in arguments]) == ExitCode.FAILED
    shown = capsys.readouterr().err
    assert shown.startswith("error: cannot write to '") and shown.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine" and sequence_path.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.h5", "scene.yaml"]


def test_a_file_that_may_not_be_read_is_one_line(sequence_path, monkeypatch, capsys):
    def refused(*about):
        raise PermissionError(13, "Permission denied", "secret.npz")

    monkeypatch.setattr("torchtrack.cli.track.open_session", refused)
    assert main(["track", str(sequence_path), "--quiet"]) == ExitCode.FAILED
    assert capsys.readouterr().err.startswith("error: cannot use 'secret.npz': Permission denied.")


def standard_output(monkeypatch, descriptor):
    stream = os.fdopen(descriptor, "w", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    return stream


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["settings"], ["info", "{sequence}"], ["info", "{sequence}", "--json"], ["--help"]])
def test_a_full_disk_behind_standard_output_is_one_line(sequence_path, monkeypatch, capsys, arguments):
    with standard_output(monkeypatch, os.open("/dev/full", os.O_WRONLY)):
        try:
            code = main([argument.format(sequence=sequence_path) for argument in arguments])
        except SystemExit as exit:
            code = exit.code
    assert code == ExitCode.FAILED
    shown = capsys.readouterr().err
    assert shown == "error: cannot write to 'standard output': No space left on device.\n"


@pytest.mark.parametrize("arguments", [["settings"], ["--help"]])
def test_a_pipe_that_nobody_reads_is_no_error(monkeypatch, capsys, arguments):
    reading, writing = os.pipe()
    os.close(reading)
    with standard_output(monkeypatch, writing), pytest.raises(SystemExit) as exit:
        raise SystemExit(main(arguments))
    assert exit.value.code == ExitCode.FAILED
    assert capsys.readouterr().err == ""


def test_an_encoding_that_lacks_a_sign_is_no_error(monkeypatch, capsys):
    written = io.BytesIO()
    with io.TextIOWrapper(written, encoding="ascii") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert main(["settings"]) == ExitCode.DONE
        assert b"(?s)" in written.getvalue()
    assert capsys.readouterr().err == ""

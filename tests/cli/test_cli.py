import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from tiny_sequence import write_tiny_sequence

import torchtrack
from torchtrack.cli.main import main, split_overrides
from torchtrack.errors import ConfigError


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=20_000)


@pytest.fixture
def config_path(sequence_path, tmp_path):
    path = tmp_path / "track.yaml"
    path.write_text(f"source: {sequence_path}\noutput: results\noverlay: {{enabled: false}}\n")
    return path


def command(*arguments):
    return main([str(argument) for argument in arguments])


def test_track_writes_into_the_folder_of_the_config(config_path, capsys):
    assert command("track", config_path, "--quiet") == 0
    assert (config_path.parent / "results" / "summary.json").is_file()
    output = capsys.readouterr().out
    assert "box" in output and "TRACKING" in output and str(config_path.parent / "results") in output


def test_options_and_dotted_settings_override_the_file(config_path, tmp_path, capsys):
    arguments = ("--tracker.window.duration-us", 10_000, "--tracker.flow.iterations=7", "-o", tmp_path / "other", "--preset", "paper", "--quiet")
    assert command("track", config_path, *arguments) == 0
    stored = (tmp_path / "other" / "config.yaml").read_text()
    assert "preset: paper" in stored and "duration_us: 10000" in stored and "iterations: 7" in stored
    assert json.loads((tmp_path / "other" / "summary.json").read_text())["windows"] == 2


def test_a_sequence_can_be_tracked_without_a_config(sequence_path, tmp_path, capsys):
    assert command("track", sequence_path, "-o", tmp_path / "out", "--overlay.enabled", "false", "--end-us", 11_000) == 0
    captured = capsys.readouterr()
    assert "trajectory_box.tum" in {path.name for path in (tmp_path / "out").iterdir()}
    assert "Traceback" not in captured.err


def test_a_method_that_cannot_be_compiled_is_told(sequence_path, tmp_path, capsys):
    assert command("track", sequence_path, "--compiled", "--preset", "line", "-o", tmp_path / "out") == 2
    shown = capsys.readouterr().err
    assert "compiling the tracker" in shown
    assert "compiled: the method 'line' cannot be compiled" in shown
    assert not (tmp_path / "out").exists()


def test_evaluate_writes_metrics_and_shows_them(sequence_path, tmp_path, capsys):
    arguments = ("--methods", "default,paper", "--jobs", 1, "--quiet", "--tracker.window.duration-us", 10_000)
    assert command("evaluate", sequence_path, "-o", tmp_path / "out", *arguments) == 0
    entries = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [(entry["method"], entry["windows"]) for entry in entries] == [("default", 1), ("paper", 1)]
    output = capsys.readouterr().out
    assert "tiny" in output and "paper" in output


def test_evaluate_takes_methods_of_a_config_by_label(sequence_path, tmp_path, capsys):
    path = tmp_path / "evaluate.yaml"
    path.write_text(f"paths: [{sequence_path}]\njobs: 1\nmethods: {{short: {{tracker: {{window: {{duration_us: 2000}}}}}}, long: {{}}}}\n")
    assert command("evaluate", "--config", path, "--methods", "short,default", "-o", tmp_path / "out", "--quiet") == 0
    entries = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [(entry["method"], entry["windows"]) for entry in entries] == [("short", 9), ("default", 3)]


def test_evaluate_fails_when_a_sequence_does(sequence_path, tmp_path, capsys):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    assert command("evaluate", tmp_path / "bad.npz", sequence_path, "-o", tmp_path / "out", "--jobs", 1, "--quiet") == 1
    captured = capsys.readouterr()
    assert "failed: bad (default)" in captured.err
    assert "tiny" in captured.out


def test_wrong_settings_end_with_2_and_one_message(config_path, capsys):
    assert command("track", config_path, "--tracker.window.duration-su", 5, "--tracker.flow.iterations", "many") == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(config_path) in captured.err and "2 settings are wrong" in captured.err
    assert "tracker.window.duration_su (command line): unknown setting; perhaps you meant 'tracker.window.duration_us'" in captured.err


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("track", "nowhere.yaml"), 1, "no config file at nowhere.yaml"),
        (("track", "nowhere.npz"), 1, "nowhere.npz"),
        (("evaluate",), 2, "nothing to evaluate"),
        (("evaluate", "nowhere"), 1, "nowhere"),
        (("evaluate", "nowhere", "--methods", "papre"), 2, "methods.papre.preset"),
        (("track", "a.npz", "--tracker.window.mode"), 2, "needs a value"),
    ],
)
def test_errors_are_told_without_a_traceback(arguments, code, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command(*arguments) == code
    error = capsys.readouterr().err
    assert expected in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("arguments", "expected"), [(["--help"], "evaluate"), (["track", "--help"], "--tracker.window.duration-us")])
def test_help(arguments, expected, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 0
    assert expected in capsys.readouterr().out


def test_settings_are_listed_a_line_each_on_two_screens(capsys):
    assert command("settings", "track") == 0
    lines = capsys.readouterr().out.splitlines()
    keys = [line.split()[0] for line in lines]
    assert {"tracker.window.duration_us", "objects[].initial_pose.matrix", "limits.*"} <= set(keys)
    assert len(lines) == len(set(keys)) <= 110


def test_settings_of_a_group_are_listed_in_full(capsys):
    assert command("settings", "track", "limits") == 0
    output = capsys.readouterr().out
    assert "limits.mesh_bytes" in output and "[≥ 1]" in output and "tracker." not in output


def test_a_group_without_settings_is_an_error(capsys):
    assert command("settings", "track", "tracker.sorcery") == 2
    assert "no setting with 'tracker.sorcery' in its name" in capsys.readouterr().err


def test_dotted_settings_are_told_from_options():
    options, overrides = split_overrides(["track", "a.yaml", "--a.b-c", "-0.5", "-o", "out", "--d.e=[1, 2]", "--quiet", "x.npz"])
    assert options == ["track", "a.yaml", "-o", "out", "--quiet", "x.npz"]
    assert overrides == {"a.b_c": -0.5, "d.e": [1, 2]}
    with pytest.raises(ConfigError, match="--a.b needs a value"):
        split_overrides(["--a.b", "--quiet"])


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, torchtrack; assert 'torch' not in sys.modules; print(sorted(torchtrack.__all__))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Tracker" in result.stdout


@pytest.mark.parametrize("arguments", [["--help"], ["track", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    code = (
        "import sys\nfrom torchtrack.cli.main import main\n"
        f"try: code = main({arguments})\nexcept SystemExit as end: code = end.code\n"
        "assert 'torch' not in sys.modules\nsys.exit(code)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "usage" in result.stdout.lower()


def test_importing_a_tracker_leaves_the_compiler_alone():
    """It takes as long to load as PyTorch itself."""
    modules = "'torchtrack.tracking.tracker' in sys.modules, 'torch._dynamo' in sys.modules"
    code = f"import sys, torchtrack.tracking.tracker, torchtrack.run.executor.on_ray; print({modules})"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["True", "False"]


def test_public_names_are_all_there():
    assert [name for name in torchtrack.__all__ if getattr(torchtrack, name, None) is None] == []
    assert set(torchtrack.__all__) <= set(dir(torchtrack))
    with pytest.raises(AttributeError, match="no attribute 'Trakcer'"):
        _ = torchtrack.Trakcer


SCENE = """
name: small
duration_s: 0.03
camera: {width: 160, height: 120, fx: 150, fy: 150}
objects:
  - label: cube
    shape: cube
    motion: {position_m: [0, 0, 0.6], rotation_deg: [30, 35, 10]}
"""


def test_simulate_and_demo(tmp_path, capsys):
    (tmp_path / "scene.yaml").write_text(SCENE)
    assert command("simulate", tmp_path / "scene.yaml", "-o", tmp_path / "alone.npz", "--quiet") == 0
    (tmp_path / "demo.yaml").write_text("scene: scene.yaml\noverlay: {enabled: false}\n")
    assert command("demo", tmp_path / "demo.yaml", "-o", tmp_path / "out", "--quiet") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"small.npz", "small_cube.ply", "trajectory_cube.tum", "poses.csv", "config.yaml", "summary.json"} <= names
    assert (tmp_path / "out" / "small_cube.ply").read_bytes() == (tmp_path / "alone_cube.ply").read_bytes()
    output = capsys.readouterr().out
    assert "cube" in output and str(tmp_path / "out") in output


def test_demo_needs_no_file(tmp_path, monkeypatch, capsys):
    """The scene comes with the package, the results go to where one is."""
    asked = []

    def simulated(scene, path, quiet):
        asked.append((scene.name, [obj.label for obj in scene.objects], path))
        return write_tiny_sequence(tmp_path, "demo")

    monkeypatch.setattr("torchtrack.cli.demo.simulated_to", simulated)
    monkeypatch.chdir(tmp_path)
    assert command("demo", "--quiet", "--overlay.enabled", "false") == 0
    assert asked == [("demo", ["cube", "lbracket"], tmp_path / "outputs" / "demo" / "demo.npz")]
    assert (tmp_path / "outputs" / "demo" / "trajectory_box.tum").exists() and str(tmp_path / "outputs" / "demo") in capsys.readouterr().out


def test_version_is_said_without_loading_pytorch():
    code = "import sys; from torchtrack.cli.main import main; code = main(['--version']); sys.exit(code or 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"torchtrack {torchtrack.__version__}\n", "")


@pytest.mark.parametrize("arguments", [("--version", "track"), ("track", "a.npz", "--version")])
def test_version_is_asked_for_alone(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        command(*arguments)
    assert caught.value.code == 2 and "--version" in capsys.readouterr().err


def test_outline_makes_a_model(tmp_path, capsys):
    picture = np.full((80, 120), 200, np.uint8)
    picture[20:50, 30:60] = 10
    cv2.imwrite(str(tmp_path / "frame.png"), picture)
    (tmp_path / "calib.txt").write_text("100 100 60 40\n")
    arguments = ("outline", tmp_path / "frame.png", "--calibration", tmp_path / "calib.txt", "-o", tmp_path / "model.json")
    assert command(*arguments, "--width", 120, "--height", 80) == 0
    assert len(json.loads((tmp_path / "model.json").read_text())["polylines"]) == 1
    assert command(*arguments, "--tracker.flow.iterations", 3) == 2
    assert "takes no settings" in capsys.readouterr().err


def test_the_package_is_run_as_the_command_is(tmp_path):
    there, nowhere = (
        subprocess.run([sys.executable, "-m", "torchtrack", *rest], capture_output=True, text=True) for rest in (["--help"], ["info", "nowhere.raw"])
    )
    assert there.returncode == 0 and "usage: torchtrack" in there.stdout
    assert nowhere.returncode == 1 and "nowhere.raw" in nowhere.stderr

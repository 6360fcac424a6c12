"""README and docs are true: their Python runs, their commands parse, and whatever they name is there."""

import re
import shlex
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest
import torch
import tyro
import yaml
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from tiny_sequence import write_tiny_sequence
from tracked_boxes import follow, moving_box, windows

from torchtrack import Tracker
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import _Command, main, split_overrides
from torchtrack.cli.settings import as_markdown
from torchtrack.config.components import Component
from torchtrack.config.demo import DemoConfig
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.events import is_live
from torchtrack.config.explain import dotted_keys
from torchtrack.config.formats import OutputFormat
from torchtrack.config.load import load
from torchtrack.config.presets import PresetName, preset
from torchtrack.config.run import RunConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import retract_about, transform_points
from torchtrack.io import Trajectory, read_calibration, write_tum
from torchtrack.run.sinks.poses import COLUMNS
from torchtrack.sim import SceneConfig
from torchtrack.sim.suite import scenes_of
from torchtrack.tracking.validation.status import Status

REPOSITORY = Path(__file__).resolve().parents[2]
FRONT = (REPOSITORY / "README.md").read_text(encoding="utf-8")
PAGES = {path.name: path.read_text(encoding="utf-8") for path in sorted((REPOSITORY / "docs").glob("*.md"))}
# All but what is generated.
README = "\n\n".join([FRONT, *(text for name, text in PAGES.items() if name != "settings.md")])
SETTINGS = {"track": RunConfig, "evaluate": EvaluateConfig, "demo": DemoConfig, "simulate": SceneConfig}
COMMANDS = ("track", "evaluate", "simulate", "demo", "outline", "model", "pose", "report", "view", "info", "convert", "bench", "settings")
BLOCKS = ("ACCURACY", "ABLATION", "TRIAL", "PAPER TABLES", "SPEED")
FILE_SUFFIXES = ("py", "yaml", "txt", "npz", "json", "csv", "tum", "mp4", "png", "obj", "glb", "md", "mcap", "html", "rrd", "raw")


def blocks(language):
    """The fenced blocks of which the info string is exactly ``language``."""
    return re.findall(rf"^```{re.escape(language)}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands():
    """Every command line of README and docs, in blocks and in running text, without the program's name."""
    lines = [line.partition("#")[0] for block in blocks("bash") for line in block.replace("\\\n", " ").splitlines()]
    quoted = re.findall(r"`(torchtrack [a-z]+ [^`]*)`", README.replace("\n", " "))
    words = [shlex.split(line) for line in (*lines, *quoted)]
    return [rest for program, *rest in filter(None, words) if program == "torchtrack" and rest[0] != "COMMAND"]


def spans():
    """Everything between single backticks, outside of blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", README, flags=re.MULTILINE | re.DOTALL))


def is_key(key, settings):
    """Whether a dotted key is a setting, or a group of settings."""
    return any(known == key or known.startswith(f"{key}.") for known in dotted_keys(settings))


@pytest.mark.parametrize("code", blocks("python"))
def test_python_runs(code, tmp_path):
    (tmp_path / "example.py").write_text(code, encoding="utf-8")
    # In a process of its own: as a reader runs it, without what tests load before.
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "torch.Size([3, 4, 4]) torch.Size([3, 6, 6])" in done.stdout


@pytest.mark.parametrize("code", blocks("python no-run"))
def test_python_that_needs_data_names_what_is_there(code):
    compile(code, "README.md", "exec")
    imported = re.findall(r"^from (torchtrack[\w.]*) import (\w+)", code, re.MULTILINE)
    used = [("torchtrack", name) for name in re.findall(r"\btorchtrack\.(\w+)", code.replace("from torchtrack.", ""))]
    assert imported or used
    for module, name in (*imported, *used):
        assert hasattr(import_module(module), name), f"{module}.{name}"


@torch.no_grad()
def test_the_cost_term_draws_a_pose_to_where_it_says():
    """Half a millimetre beside the truth, where events alone leave it."""
    (code,), shown = blocks("python cost-term"), {}
    exec(compile(code, "architecture.md", "exec"), shown)
    trajectory, events = moving_box(pose(), 4)
    *before, (last, end_us) = windows(events, 4)
    tracker = Tracker([box_model()], SMALL_CAMERA, dtype=torch.float64)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), before)
    T_said = retract_about(trajectory.at(torch.tensor([end_us])), torch.tensor([[0.0, 0, 0, 5e-4, 0, 0]]).double(), tracker.centre_obj)
    points_obj = torch.tensor([[[0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05], [-0.05, 0, 0], [0, -0.05, 0]]]).double()
    pixels = project(transform_points(T_said, points_obj), tracker.intrinsics)
    _, with_pairs = shown["step_with_pairs"](tracker, state, last, end_us, points_obj, pixels)
    millimetres = [float(pose_errors(result.T_cam_obj, T_said)[1]) for result in (tracker.step(state, last, end_us)[1], with_pairs)]
    assert millimetres[0] > 0.2 and millimetres[1] < 0.02


@pytest.mark.parametrize("arguments", commands(), ids=" ".join)
def test_command_lines_parse(arguments):
    options, overrides = split_overrides(arguments)
    command = tyro.cli(_Command, args=options)
    assert type(command).__name__.lower() == arguments[0]
    for key in overrides:
        assert is_key(key, SETTINGS[arguments[0]]), key


def test_every_command_is_shown():
    assert {arguments[0] for arguments in commands()} == set(COMMANDS)


def test_commands_are_all_that_there_are(capsys):
    with pytest.raises(SystemExit):
        tyro.cli(_Command, args=["--help"])
    assert set(re.findall(r"• (\w+)", capsys.readouterr().out)) == set(COMMANDS)


def test_options_in_running_text_exist(capsys):
    ours = [span for span in spans() if not span.startswith(("scripts/", "pip "))]
    options = {option for span in ours for option in re.findall(r"(?<![\w-])--([a-z][\w.-]*)", span)}
    with_dots = {option for option in options if "." in option}
    assert with_dots and options - with_dots
    for option in with_dots:
        assert is_key(option.replace("-", "_"), RunConfig), option
    for command in COMMANDS:
        with pytest.raises(SystemExit):
            tyro.cli(_Command, args=[command, "--help"])
    with pytest.raises(SystemExit):
        main(["--help"])
    helped = capsys.readouterr().out
    for option in options - with_dots:
        assert f"--{option}" in helped, option


def test_dotted_names_exist():
    names = {span for span in spans() if re.fullmatch(r"[a-z]\w*(\.\w+)+", span) and not span.endswith(FILE_SUFFIXES)}
    assert {"tracker.window.duration_us", "overlay.enabled", "camera.width"} <= names
    for name in names:
        package, _, attribute = name.partition(".")
        if package == "torchtrack":
            assert hasattr(import_module(package), attribute), name
        else:
            assert any(is_key(name, settings) for settings in (RunConfig, SceneConfig)), name


def test_settings_named_alone_exist():
    every = {part for key in dotted_keys(RunConfig) for part in key.split(".")}
    named = {"initial_pose", "start_us", "translation_m", "quaternion_xyzw", "matrix", "trajectory", "polylines", "mesh", "unit", "scale", "centre"}
    assert named | {"source", "sensor_latency_us"} <= every & set(spans())


def test_what_each_component_does_is_said():
    assert {str(component) for component in Component} <= set(spans())


def test_files_exist():
    named = set(re.findall(r"[`(\s]((?:configs|scripts|tests|torchtrack|docs|\.github)/[\w./-]*\w|LICENSE)", README))
    assert {"configs/track/shapes_rotation.yaml", "scripts/demo", "torchtrack/tracking/step.py", "LICENSE"} <= named
    for path in named:
        assert (REPOSITORY / path).exists(), path


@pytest.mark.parametrize("text", blocks("yaml track"))
def test_example_of_a_config_is_one(text, tmp_path):
    path = tmp_path / "mug.yaml"
    path.write_text(text)
    config = load(RunConfig, path)
    assert config.objects[0].mesh == tmp_path / "mug.obj" and config.objects[0].unit == "mm"


@pytest.mark.parametrize("text", blocks("yaml evaluate"))
def test_example_of_an_evaluation_is_one(text, tmp_path):
    path = tmp_path / "trial.yaml"
    path.write_text(text)
    assert load(EvaluateConfig, path).methods["drift_and_lines"].tracker.disabled == {Component.DRIFT, Component.LINE_ENDS}


@pytest.mark.parametrize("text", blocks("yaml simulate"))
def test_example_of_a_scene_is_one(text, tmp_path):
    path = tmp_path / "mug_scene.yaml"
    path.write_text(text)
    scenes = scenes_of(path)
    assert [scene.name for scene in scenes] == ["mug_fast", "mug_dim", "mug_occluded"]
    assert scenes[0].objects[0].mesh == tmp_path / "mug.obj" and scenes[0].objects[0].unit == "mm"


@pytest.mark.parametrize("text", blocks("yaml calibration"))
def test_example_of_a_calibration_is_one(text, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    camera = read_calibration(path)
    assert (camera.width, camera.height, camera.distortion_model) == (240, 180, "plumb_bob")


def flat(settings, prefix="tracker"):
    """Dotted key to value."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}.{name}")
        else:
            yield f"{prefix}.{name}", list(value) if isinstance(value, tuple) else value


def test_table_of_presets_is_true_and_complete():
    names = re.search(r"^\| key \| (.+) \|$", README, re.MULTILINE)[1].replace("`", "").split(" | ")
    assert names == list(get_args(PresetName))
    settings = {name: dict(flat(preset(name).model_dump())) for name in names}
    row = r"^\| `(tracker\.[\w.]+)`" + len(names) * r" \| ([^|]+)" + r" \|$"
    rows = re.findall(row, README, re.MULTILINE)
    assert len(rows) >= 8
    for key, *values in rows:
        assert [yaml.safe_load(value) for value in values] == [settings[name][key] for name in names], key
    different = {key for name in names for key, value in settings[name].items() if value != settings["default"][key]}
    assert different <= set(spans())


def test_formats_extras_and_live_sources_are_true():
    table = README[README.index("| format | `convert` writes") :].partition("\n\n")[0]
    written = {name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[2])}
    assert written == set(get_args(OutputFormat))
    named = set(re.findall(r"extras? `(\w+)`|needs `(\w+)`", README))
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"aedat", "hdf5", "ros", "live"} <= {name for pair in named for name in pair if name} <= set(extras)
    addresses = {span for span in spans() if "://" in span and "=" not in span}
    assert {"dv://HOST:PORT", "davis://", "evk4://", "ros:///TOPIC", "stdin://"} == addresses
    assert all(is_live(address) for address in addresses | {"-"})


@pytest.mark.parametrize("name", BLOCKS)
def test_blocks_of_figures_can_be_filled_in(name):
    assert len(re.findall(rf"^<!-- {name} -->\n.+?\n<!-- /{name} -->$", README, re.MULTILINE | re.DOTALL)) == 1


def test_statuses_columns_and_exit_codes_are_true():
    for status in Status:
        assert f"| `{status.name}` |" in README
    assert {"status", "quality", "observations"} <= set(COLUMNS)
    exits = re.search(r"Exit codes: (\d+) done, (\d+) failed, (\d+) wrong settings, (\d+) an object was hardly tracked,\s(\d+) interrupted", README)
    assert exits and [int(code) for code in exits.groups()] == sorted(ExitCode)


def test_pictures_are_few_and_small():
    pictures = sorted((REPOSITORY / "docs" / "images").iterdir())
    assert 0 < sum(picture.stat().st_size for picture in pictures) < 300_000
    for picture in pictures:
        assert picture.suffix == ".webp"
        assert f"images/{picture.name})" in README


def test_length_and_places():
    assert len(FRONT.encode()) <= 8192
    outside_blocks = re.sub(r"^```text.*?^```", "", README, flags=re.MULTILINE | re.DOTALL)
    assert [line for line in outside_blocks.splitlines() if len(line) > 120 and not line.startswith("|")] == []
    assert re.findall(r"(?<![\w.])/(?:work|home|tmp|root)/", README) == []


def test_links_lead_somewhere():
    for folder, text in ((REPOSITORY, FRONT), *((REPOSITORY / "docs", text) for text in PAGES.values())):
        for target in re.findall(r"\]\(([^)#]+)", text):
            assert target.startswith("https://") or (folder / target).exists(), target


def test_settings_are_those_that_there_are():
    assert PAGES["settings.md"].endswith(as_markdown("track")), "run scripts/docs"


@pytest.mark.parametrize("code", blocks("python learn"))
def test_learning_runs(code, tmp_path):
    (tmp_path / "outputs" / "demo").mkdir(parents=True)
    write_tiny_sequence(tmp_path / "outputs" / "demo", "demo", ("box", "other"))
    (tmp_path / "example.py").write_text(code, encoding="utf-8")
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"(\d+\.\d+ mm\n){2}", done.stdout) and len(code.splitlines()) < 30


@pytest.mark.parametrize("code", blocks("python bop"))
def test_results_for_bop_are_written(code, tmp_path, monkeypatch, capsys):
    (tmp_path / "outputs" / "mug").mkdir(parents=True)
    write_tum(tmp_path / "outputs" / "mug" / "trajectory_mug.tum", Trajectory(torch.tensor([5_000, 105_000]), torch.eye(4).repeat(2, 1, 1)))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "example.py", "exec"), {})
    assert capsys.readouterr().out == "3 images\n"
    assert len((tmp_path / "outputs" / "torchtrack_ycbv-test.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize("code", blocks("python live"))
def test_pushing_events_runs(code, tmp_path):
    (tmp_path / "example.py").write_text(code, encoding="utf-8")
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.split(" ", 2) for line in done.stdout.splitlines()]
    assert [int(t_us) for t_us, *_ in rows] == [5_000, 10_000, 15_000]
    assert {status for _, status, _ in rows} <= {status.name for status in Status}

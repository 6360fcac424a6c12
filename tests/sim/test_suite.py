"""Many scenes at once: variants, lists, folders; what is there is kept, what fails is told."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.errors import ConfigError, EventDataError, MissingFileError
from torchtrack.io.sequence import read_sequence
from torchtrack.sim import SceneConfig
from torchtrack.sim.render import Frame
from torchtrack.sim.suite import is_done, is_suite, run_suite, scenes_of, simulate_to_file

TINY = "camera: {width: 60, height: 40, fx: 60, fy: 60}\nduration_s: 0.02\nobjects: [{label: cube, shape: cube}]\n"
VARIANTS = "variants:\n  calm: {speed: 0.5}\n  noisy: {noise: realistic, camera: {width: 64}}\n"


@pytest.fixture
def suite(tmp_path):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.yaml").write_text(f"name: a\n{TINY}")
    (tmp_path / "scenes" / "b.yaml").write_text(f"name: b\n{TINY}{VARIANTS}")
    (tmp_path / "suite.yaml").write_text("scenes: [scenes/*.yaml]\n")
    return tmp_path / "suite.yaml"


def needs_numba():
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")


def test_a_suite_is_all_its_scenes_and_variants(suite):
    scenes = scenes_of(suite, {"seed": 7})
    assert [scene.name for scene in scenes] == ["a", "b_calm", "b_noisy"]
    assert scenes[1].speed == 0.5
    assert (scenes[2].noise, scenes[2].camera.width, scenes[2].camera.height) == ("realistic", 64, 40)
    assert {scene.seed for scene in scenes} == {7}
    assert scenes_of(suite.parent / "scenes") == scenes_of(suite)
    assert [scene.name for scene in scenes_of(suite.parent / "scenes" / "b.yaml", {"variant": "calm"})] == ["b_calm"]
    assert is_suite(suite)
    assert is_suite(suite.parent / "scenes")
    assert not is_suite(suite.parent / "scenes" / "a.yaml")


def test_a_variant_is_a_scene_of_its_own_that_can_be_read_back(suite):
    scene = scenes_of(suite)[2]
    assert scene.variants == {}
    assert SceneConfig.model_validate(scene.model_dump(mode="json")) == scene


def test_suites_that_make_no_sense_are_errors(suite):
    folder = suite.parent
    with pytest.raises(ConfigError, match="none called 'wild'"):
        scenes_of(folder / "scenes" / "b.yaml", {"variant": "wild"})
    (folder / "self.yaml").write_text("scenes: [self.yaml]\n")
    with pytest.raises(ConfigError, match="contains itself"):
        scenes_of(folder / "self.yaml")
    (folder / "twice.yaml").write_text("scenes: [scenes/a.yaml, scenes]\n")
    with pytest.raises(ConfigError, match="several scenes are called a"):
        scenes_of(folder / "twice.yaml")
    (folder / "none.yaml").write_text("scenes: [nowhere/*.yaml]\n")
    with pytest.raises(MissingFileError, match="nowhere"):
        scenes_of(folder / "none.yaml")
    (folder / "empty").mkdir()
    with pytest.raises(MissingFileError, match="holds no scene"):
        scenes_of(folder / "empty")


def test_a_suite_runs_in_processes_tells_its_progress_and_is_taken_up_again(suite, tmp_path, monkeypatch):
    needs_numba()
    scenes, progress = scenes_of(suite), []
    out = tmp_path / "out"
    simulate_to_file(scenes[0], out / "a.npz")
    kept = (out / "a.npz").stat().st_mtime_ns
    broken = scenes[1].model_copy(update={"name": "broken", "peak_speed": 20_000.0, "speed": 1.0})
    failures = run_suite([*scenes, broken], out, 2, lambda name, share: progress.append((name, share)))
    assert [failure.name for failure in failures] == ["broken"]
    assert "peak_speed" in failures[0].reason
    assert sorted(path.name for path in out.glob("*.npz")) == ["a.npz", "b_calm.npz", "b_noisy.npz"]
    assert (out / "a.npz").stat().st_mtime_ns == kept
    assert {name for name, share in progress if share == 1.0} == {"a", "b_calm", "b_noisy", "broken"}
    assert all(is_done(scene, out / f"{scene.name}.npz") for scene in scenes)
    # Other settings make another sequence; a damaged one is made again.
    assert not is_done(scenes[0].model_copy(update={"seed": 9}), out / "a.npz")
    # A setting that its file does not know yet is as by default.
    stored = read_sequence(out / "a.npz").meta["scene"]
    del stored["objects"][0]["attached_to"]
    monkeypatch.setattr("torchtrack.sim.suite.read_sequence", lambda path: SimpleNamespace(meta={"scene": stored}))
    assert is_done(scenes[0], out / "a.npz")
    monkeypatch.undo()
    (out / "a.npz").write_bytes((out / "a.npz").read_bytes()[:1000])
    assert not is_done(scenes[0], out / "a.npz")
    again = []
    assert run_suite(scenes[1:], out, 2, lambda name, share: again.append((name, share))) == []
    assert again == [("b_calm", 1.0), ("b_noisy", 1.0)]


def test_a_scene_that_breaks_off_leaves_nothing(suite, tmp_path, monkeypatch):
    needs_numba()
    scene = scenes_of(suite)[0]

    def interrupted(share):
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_to_file(scene, tmp_path / "out" / "a.npz", interrupted)
    monkeypatch.setattr("torchtrack.io.sequence.np.savez", lambda *args, **kwargs: interrupted(1.0))
    with pytest.raises(KeyboardInterrupt):
        simulate_to_file(scene, tmp_path / "out" / "a.npz")
    assert not list((tmp_path / "out").iterdir())
    with pytest.raises(EventDataError, match=r"\.npz"):
        simulate_to_file(scene, tmp_path / "a.txt")


def test_the_command_makes_one_variant_with_a_preview(suite, tmp_path, capsys):
    needs_numba()
    file = str(suite.parent / "scenes" / "b.yaml")
    assert main(["simulate", file, "-o", str(tmp_path / "out"), "--variant", "calm", "--preview", "--quiet"]) == ExitCode.DONE
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["b_calm.mp4", "b_calm.npz", "b_calm_cube.ply", "b_calm_cube_textured.glb"]
    assert read_sequence(tmp_path / "out" / "b_calm.npz").meta["speed"] == 0.5
    assert main(["simulate", file, "-o", str(tmp_path / "all.npz"), "--quiet"]) == ExitCode.WRONG_SETTINGS
    assert "--variant" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scene.yaml"], "needs an output"),
        (["-o", "x.npz"], "either the file of a scene or --video"),
        (["scene.yaml", "--video", "v.mp4", "-o", "x.npz"], "not both"),
        (["scene.yaml", "--fps", "30", "-o", "x.npz"], "are for --video"),
    ],
)
def test_commands_that_make_no_sense_are_errors(arguments, message, capsys):
    assert main(["simulate", *arguments]) == ExitCode.WRONG_SETTINGS
    assert message in " ".join(capsys.readouterr().err.split())


def test_contours_of_a_preview_are_where_something_else_begins():
    from torchtrack.sim.preview import _contours

    owner, depth = np.full((5, 8), -1, dtype=np.int16), np.full((5, 8), np.inf, dtype=np.float32)
    owner[:, 2:7], depth[:, 2:4], depth[:, 4:7] = 0, 0.5, 0.6
    edge = _contours(Frame(np.zeros((5, 8), np.float32), depth, owner, ()))
    assert np.flatnonzero(edge[2]).tolist() == [1, 2, 3, 4, 6, 7]

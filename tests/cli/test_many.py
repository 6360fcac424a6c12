"""Many sources on the command line: batches of streams, processes, Ray; what goes together, and what does not."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from elsewhere import Elsewhere
from places import REPOSITORY, needs_ray

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.eval.evaluate import evaluate
from torchtrack.run.sinks.summary import finite

SCENE = "name: a\ncamera: {width: 60, height: 40, fx: 60, fy: 60}\nduration_s: 0.02\nobjects: [{label: cube, shape: cube}]\n"


def test_track_takes_many_sources_at_once(folder, tmp_path, capsys):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    (tmp_path / "of_file.yaml").write_text(f"source: {folder / 'two.npz'}\n")
    sources = [str(folder / "one.npz"), str(tmp_path / "bad.npz"), str(tmp_path / "of_file.yaml")]
    assert main(["track", *sources, "--streams", "2", "-o", str(tmp_path / "out"), "--overlay.enabled", "false"]) == ExitCode.FAILED
    captured = capsys.readouterr()
    assert "failed:" in captured.err and "bad.npz" in captured.err
    assert "right" in captured.out and "Results are in" in captured.out
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("summary.json")) == [
        "of_file/summary.json",
        "one/summary.json",
    ]


def metrics(folder):
    """What an evaluation measured, without what differs from run to run."""
    entries = json.loads((folder / "metrics.json").read_text())
    return [{name: value for name, value in entry.items() if name != "median_step_ms"} for entry in entries]


def assert_close(entries, expected):
    assert [(entry["sequence"], entry["object"], entry["status"]) for entry in entries] == [
        (entry["sequence"], entry["object"], entry["status"]) for entry in expected
    ]
    for entry, other in zip(entries, expected, strict=True):
        assert entry["mean_rotation_deg"] == pytest.approx(other["mean_rotation_deg"], abs=0.03)
        assert entry["max_translation_cm"] == pytest.approx(other["max_translation_cm"], abs=0.02)


def test_evaluate_gives_the_same_with_streams(folder, tmp_path, capsys):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    arguments = ["evaluate", str(tmp_path / "bad.npz"), str(folder), "--methods", "default,nns", "--jobs", "1", "--quiet"]
    assert main([*arguments, "-o", str(tmp_path / "alone")]) == ExitCode.FAILED
    assert main([*arguments, "--streams", "3", "-o", str(tmp_path / "together")]) == ExitCode.FAILED
    assert capsys.readouterr().err.count("failed: bad (nns)") == 2
    entries, expected = metrics(tmp_path / "together"), metrics(tmp_path / "alone")
    assert len(entries) == 6
    assert_close(entries, expected)


def test_an_evaluation_tells_of_each_sequence_of_a_batch(folder, tmp_path):
    done = []
    evaluation = evaluate(EvaluateConfig(paths=(folder,), jobs=1, streams=2, output=tmp_path / "out"), done.append)
    assert [job.path.stem for job in done] == ["one", "two"]
    assert [finite(result.metrics.as_dict())["windows"] for result in evaluation.results] == [5, 3, 3]


@pytest.fixture(scope="module")
def cluster():
    """The address of a Ray cluster on this machine."""
    ray = pytest.importorskip("ray", reason="needs ray: pip install 'torchtrack[cluster]'")
    # One process of it takes all: each takes seconds to start.
    context = ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
    yield context.address_info["gcs_address"]
    ray.shutdown()


@needs_ray
def test_evaluate_gives_the_same_on_a_ray_cluster(cluster, folder, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    arguments = ["evaluate", str(tmp_path / "bad.npz"), str(folder), "--methods", "default", "--quiet"]
    assert main([*arguments, "--jobs", "1", "-o", str(tmp_path / "local")]) == ExitCode.FAILED
    environment = {**os.environ, "RAY_ADDRESS": cluster, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", "import sys; from torchtrack.cli.main import main; sys.exit(main())", *arguments, "--executor", "ray"]
    done = subprocess.run([*command, "-o", str(tmp_path / "ray")], env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == ExitCode.FAILED, done.stderr
    assert "failed: bad (default)" in done.stderr
    assert metrics(tmp_path / "ray") == metrics(tmp_path / "local")


def test_simulate_gives_the_same_elsewhere_as_here(tmp_path, monkeypatch):
    """On what stands in for Ray; an evaluation is on a real cluster, above."""
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")
    (tmp_path / "scenes").mkdir()
    for name in "ab":
        (tmp_path / "scenes" / f"{name}.yaml").write_text(SCENE.replace("name: a", f"name: {name}"))
    arguments = ["simulate", str(tmp_path / "scenes"), "--quiet"]
    assert main([*arguments, "--jobs", "1", "-o", str(tmp_path / "local")]) == ExitCode.DONE
    elsewhere = Elsewhere()
    monkeypatch.setattr("torchtrack.run.executor.on_ray.run_on_ray", elsewhere)
    assert main([*arguments, "--executor", "ray", "-o", str(tmp_path / "ray")]) == ExitCode.DONE
    assert len(elsewhere.jobs) == 1
    for name in "ab":
        expected, by_ray = (dict(np.load(tmp_path / where / f"{name}.npz")) for where in ("local", "ray"))
        assert all(np.array_equal(by_ray[key], expected[key]) for key in ("t", "x", "y", "p", "poses"))


def test_ray_that_is_missing_is_told(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["evaluate", str(folder), "--executor", "ray", "--quiet", "-o", str(tmp_path / "out")]) == ExitCode.FAILED
    assert "pip install 'torchtrack[cluster]'" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["track"], "needs a config file or a source"),
        (["track", "a.npz", "--streams", "2"], "streams: only for several sources"),
        (["track", "a.npz", "--jobs", "2", "--executor", "ray"], "jobs, executor: only for several sources"),
        (["track", "a.npz", "b.npz", "--streams", "0"], "streams: at least one is needed, got 0"),
        (["track", "a.npz", "sub/a.npz"], "several sources would go to"),
        (["evaluate", "a.npz", "--streams", "0"], "streams"),
        (["evaluate", "a.npz", "--executor", "ray", "--estimate-latency"], "executor: not with --estimate-latency"),
        (["simulate", "scene.yaml", "-o", "a.npz", "--executor", "ray"], "is for several scenes"),
        (["simulate", "--video", "clip.mp4", "-o", "a.npz", "--executor", "ray"], "not for --video"),
        (["simulate", "scenes", "-o", "out", "--jobs", "0"], "at least one process is needed"),
    ],
)
def test_options_that_do_not_fit_are_errors(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.yaml").write_text(SCENE)
    assert main([*arguments, "--quiet"]) == ExitCode.WRONG_SETTINGS
    assert message in " ".join(capsys.readouterr().err.split())


def test_an_executor_that_is_not_known_is_an_error(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "a.npz", "--executor", "slurm"])
    assert ended.value.code == ExitCode.WRONG_SETTINGS
    assert "invalid choice 'slurm'" in capsys.readouterr().err

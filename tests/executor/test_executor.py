"""Tasks in this process, in processes, and on Ray: what fails is told, what was killed is tried again, nothing is left behind."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import odd_tasks
import pytest
from places import REPOSITORY, needs_ray

from torchtrack.errors import ConfigError, MissingExtraError
from torchtrack.run.executor import ATTEMPTS, TaskFailure, run_tasks
from torchtrack.run.executor.groups import grouped, run_in_groups

PARALLEL = ["local", pytest.param("ray", marks=needs_ray)]


@pytest.fixture(scope="module", params=PARALLEL)
def mixed(request, tmp_path_factory):
    """Many kinds of tasks at once: their outcomes by kind, what was told, and the folder of the marks."""
    folder, progress = tmp_path_factory.mktemp("marks"), []
    tasks = {
        "killed": folder / "tries",
        "error": "too bad",
        "killed once": folder / "mark",
        "bug": 0,
        "tell": (0.25, 0.5),
        "double": 21,
    }
    kinds = list(tasks)
    with pytest.MonkeyPatch.context() as patch:
        # Ray's workers do not know the folder of the tests.
        patch.setenv("PYTHONPATH", os.pathsep.join([str(REPOSITORY / "tests" / "support"), str(REPOSITORY)]))
        ended = run_tasks(odd_tasks.do, list(tasks.items()), request.param, 2, lambda number, share: progress.append((number, share)))
        return {kinds[number]: outcome for number, outcome in ended}, progress, folder


def test_every_task_has_an_outcome(mixed):
    outcomes, _, _ = mixed
    assert len(outcomes) == 6
    assert outcomes["double"] == 42


def test_errors_are_told_and_bugs_with_their_place(mixed):
    outcomes, _, _ = mixed
    assert outcomes["error"] == TaskFailure("too bad")
    assert "ZeroDivisionError" in outcomes["bug"].reason and "odd_tasks.py" in outcomes["bug"].reason


def test_a_task_whose_process_was_killed_is_tried_again(mixed):
    outcomes, _, folder = mixed
    assert (folder / "mark").exists()
    assert outcomes["killed once"] == "survived"


def test_a_task_that_no_process_survives_fails_in_the_end(mixed):
    outcomes, _, folder = mixed
    assert isinstance(outcomes["killed"], TaskFailure) and "memory" in outcomes["killed"].reason
    assert len((folder / "tries").read_text()) == ATTEMPTS


def test_progress_is_told(mixed):
    outcomes, progress, _ = mixed
    assert progress == [(4, 0.25), (4, 0.5)]
    assert outcomes["tell"] != os.getpid()


def test_one_process_is_this_one():
    progress = []
    tasks = [("tell", (0.5,)), ("error", "too bad"), ("double", 1)]
    outcomes = run_tasks(odd_tasks.do, tasks, "local", 1, lambda number, share: progress.append((number, share)))
    assert list(outcomes) == [(0, os.getpid()), (1, TaskFailure("too bad")), (2, 2)]
    assert progress == [(0, 0.5)]


@pytest.mark.parametrize("executor", PARALLEL)
def test_nothing_to_do(executor):
    assert list(run_tasks(odd_tasks.do, [], executor, 2)) == []


def test_fewer_than_one_process_is_an_error():
    with pytest.raises(ConfigError, match="at least one process is needed, got 0"):
        run_tasks(odd_tasks.do, [("double", 1)], "local", 0)


def test_ray_that_is_missing_is_told_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"executor 'ray' needs the library 'ray'.*pip install 'torchtrack\[cluster\]'"):
        run_tasks(odd_tasks.do, [("double", 1)], "ray", 1)


@needs_ray
def test_a_cluster_that_is_not_there_is_an_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(ConfigError, match="RAY_ADDRESS=127.0.0.1:1"):
        list(run_tasks(odd_tasks.do, [("double", 1)], "ray", 1))


@pytest.mark.parametrize("executor", PARALLEL)
def test_an_interrupt_ends_the_processes_and_leaves_nothing_half_written(executor, tmp_path):
    command = [sys.executable, str(REPOSITORY / "tests" / "support" / "odd_tasks.py"), executor, str(tmp_path)]
    # A shell lets its background jobs ignore the interrupt, and they hand that on.
    heeding = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    program = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=heeding)
    begun = [tmp_path / "0.begun", tmp_path / "1.begun"]
    deadline = time.monotonic() + 120
    while not all(path.exists() and path.read_text() for path in begun) and time.monotonic() < deadline:
        assert program.poll() is None, program.stderr.read()
        time.sleep(0.05)
    program.send_signal(signal.SIGINT)
    _, errors = program.communicate(timeout=60)
    assert errors.count("Traceback") == 1 and errors.rstrip().endswith("KeyboardInterrupt")
    assert sorted(tmp_path.iterdir()) == begun
    for path in begun:
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


def test_groups_are_of_what_is_alike():
    assert grouped("abababa", 2) == [[0, 2], [1, 3], [4, 6], [5]]
    assert grouped([], 3) == []


def test_what_becomes_of_a_group_becomes_of_its_items():
    def work(items, tell):
        if "bad" in items:
            raise ConfigError("too bad")
        return [item.upper() for item in items]

    outcomes = list(run_in_groups(work, ["a", "bad", "b", "c", "d"], [0, 1, 0, 1, 0], 2, "local", 1))
    assert outcomes == [([0, 2], ["A", "B"]), ([1, 3], [TaskFailure("too bad")] * 2), ([4], ["D"])]

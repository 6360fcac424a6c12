"""Whether the tree here computes the same digits as the tree at another commit: the same events through both, in two processes.

    scripts/same_digits            against the commit that tests/pins/base names
    scripts/same_digits BASE       against another one
    scripts/same_digits --short    fewer settings, as continuous integration runs it

It says what was compared, and fails at the first difference. The tree here is as it lies in the folder, committed or not.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import torch
from comparison import ADDED, RENAMED, first_difference, is_searched_for
from scenes import DURATION_US, SCENES, write_scenes

REPOSITORY = Path(__file__).resolve().parents[2]
PINNED = REPOSITORY / "tests" / "pins" / "base"
# Lengths of windows (µs), as the presets have them.
WINDOW_US = {"default": 5_000, "guided": 5_000, "paper": 3_000, "nns": 5_000, "line": 3_000}


@dataclass(frozen=True)
class Run:
    """One scene through the tracker: by which preset, in which precision, with or without kernels, refined by what comes later or not."""

    scene: str
    preset: str
    dtype: str
    kernels: bool
    refined: bool
    window_us: int
    windows: int

    def __str__(self) -> str:
        way = "kernels" if self.kernels else "no kernels"
        return f"{self.scene:22} {self.preset + (' refined' if self.refined else ''):16} {self.dtype:8} {way:10}"


def _run(scene: str, preset: str, dtype: str, *, kernels: bool, refined: bool = False, share: float = 1.0) -> Run:
    window_us = WINDOW_US[preset]
    return Run(scene, preset, dtype, kernels, refined, window_us, int(share * DURATION_US) // window_us)


def all_runs() -> list[Run]:
    """Every scene × preset × precision × way, and of scenes of one stream what ``track`` refines."""
    runs = [
        _run(scene, preset, dtype, kernels=kernels)
        for scene, preset, dtype, kernels in product(SCENES, WINDOW_US, ("float32", "float64"), (True, False))
        if preset != "line" or SCENES[scene].straight
    ]
    return runs + [_run(name, "default", "float32", kernels=True, refined=True) for name, scene in SCENES.items() if len(scene.cameras) == 1]


def short_runs() -> list[Run]:
    """Every scene by the default with and without kernels; the other presets, and float64 without kernels, for a few windows.

    Kernels are in float32 alone: a fresh clone has to compile them, for both trees.
    """
    others = [preset for preset in WINDOW_US if preset != "default"]
    return [
        *(_run(scene, "default", "float32", kernels=kernels) for scene, kernels in product(SCENES, (True, False))),
        *(_run("textured plate", preset, "float32", kernels=True, share=0.2) for preset in others),
        *(_run("box", preset, "float64", kernels=False, share=0.2) for preset in others),
        _run("2 streams x 2 objects", "default", "float64", kernels=False, share=0.2),
        _run("box", "default", "float32", kernels=True, refined=True),
    ]


class Tracking:
    """A process that takes the runs with the torchtrack of one tree."""

    def __init__(self, tree: Path, folder: Path, name: str) -> None:
        self.name, self.outputs, self.errors = name, folder / name, folder / f"{name}.txt"
        self.outputs.mkdir()
        command = [sys.executable, str(Path(__file__).parent / "runner.py"), str(folder), str(self.outputs), str(folder / "runs.json"), str(tree)]
        environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        with self.errors.open("w") as errors:
            self.process = subprocess.Popen(
                command,
                cwd=tree,
                env=environment | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )

    def windows_of(self, number: int) -> list[dict[str, torch.Tensor]]:
        """What a run gave, once it is done."""
        # One line for each run that is stored.
        if self.process.stdout is None or not self.process.stdout.readline():
            status = self.process.wait()
            raise SystemExit(f"same_digits: run {number} failed with the torchtrack {self.name}, exit {status}:\n{self.errors.read_text()[-4000:]}")
        path = self.outputs / f"{number}.pt"
        windows: list[dict[str, torch.Tensor]] = torch.load(path)
        path.unlink()
        return windows

    def __enter__(self) -> "Tracking":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def compare(runs: list[Run], base_tree: Path, folder: Path) -> None:
    """Take the runs with both trees, say what is equal, and stop at the first difference."""
    write_scenes(folder, sorted({run.scene for run in runs}))
    (folder / "runs.json").write_text(json.dumps([asdict(run) for run in runs]))
    with Tracking(base_tree, folder, "at BASE") as base, Tracking(REPOSITORY, folder, "here") as here:
        for number, run in enumerate(runs):
            theirs, ours = base.windows_of(number), here.windows_of(number)
            difference = first_difference(theirs, ours)
            if difference:
                _say(f"{run} DIFFERENT in window {difference.window} of {len(ours)}, field {difference.field}:\n    {difference.what}")
                raise SystemExit(1)
            note = ""
            if SCENES[run.scene].is_searched and run.preset == "default" and not run.refined:
                if not is_searched_for(ours, SCENES[run.scene].cameras[0].focal_px):
                    raise SystemExit(f"same_digits: {run.scene}: the object was not found by a search, for which this scene is there.")
                note = ", found by a search"
            _say(f"{run} {len(ours)} windows, {len(ours[0])} fields: equal{note}")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _git(*arguments: str) -> str:
    return subprocess.run(["git", "-C", str(REPOSITORY), *arguments], check=True, capture_output=True, text=True).stdout.strip()


def commit_of(name: str) -> str | None:
    """The full hash of a commit, or None where this clone lacks it."""
    try:
        return _git("rev-parse", "--verify", "--quiet", f"{name}^{{commit}}")
    except subprocess.CalledProcessError:
        return None


@contextmanager
def tree_of(commit: str, folder: Path) -> Iterator[Path]:
    """A worktree of a commit, removed at the end. Kernels that it compiles are kept in git's folder, for the next time."""
    tree = folder / "tree"
    kept = Path(_git("rev-parse", "--path-format=absolute", "--git-common-dir")) / "same_digits" / commit
    _git("worktree", "add", "--detach", "--force", str(tree), commit)
    try:
        if kept.is_dir():
            shutil.copytree(kept, tree, dirs_exist_ok=True)
        yield tree
    finally:
        _keep_kernels(tree, kept)
        _git("worktree", "remove", "--force", str(tree))


def _keep_kernels(tree: Path, kept: Path) -> None:
    """Keep what Numba has compiled in a tree, if that is more than what is kept."""
    compiled = [path.relative_to(tree) for pattern in ("*.nbi", "*.nbc") for path in tree.rglob(pattern)]
    if len(compiled) <= sum(path.is_file() for path in kept.rglob("*")):
        return
    shutil.rmtree(kept, ignore_errors=True)
    for path in compiled:
        (kept / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(tree / path, kept / path)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", nargs="?", help="commit to compare with; the one in tests/pins/base when not given")
    parser.add_argument("--short", action="store_true", help="fewer settings and windows")
    arguments = parser.parse_args()
    name = arguments.base or PINNED.read_text().strip()
    commit = commit_of(name)
    if commit is None:
        if arguments.base:
            raise SystemExit(f"same_digits: there is no commit '{name}' in this clone.")
        _say(f"same_digits: skipped: commit {name} is not in this clone")
        return
    runs, start = short_runs() if arguments.short else all_runs(), time.monotonic()
    _say(f"same_digits: {commit} against {REPOSITORY}")
    _say("left out: " + "; ".join(f"{name} by line (it has no straight edges)" for name, scene in SCENES.items() if not scene.straight))
    for there, here in RENAMED.items():
        _say(f"field {there} at BASE: " + ("no longer here, not compared" if here is None else f"compared with {here} here"))
    for field in sorted(ADDED):
        _say(f"field {field}: only here, not compared")
    # Whoever ends this finds no worktree left behind.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("same_digits: terminated"))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="same_digits-")))
        compare(runs, stack.enter_context(tree_of(commit, folder)), folder)
    _say(f"same_digits: all equal: {len(runs)} runs, {sum(run.windows for run in runs)} windows, in {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()

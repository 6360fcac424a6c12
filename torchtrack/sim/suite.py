"""Many scenes at once: in parallel, with progress, and taken up again where it was broken off.

::

    scenes = scenes_of(Path("configs/simulate/paper.yaml"))
    failures = run_suite(scenes, Path("outputs/paper"), jobs=4)

A suite is a YAML file ``scenes: [paper/*.yaml, other.yaml]``, a folder of YAML files, or a scene with variants.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from torchtrack.config.executor import ExecutorName
from torchtrack.config.load import load, read_yaml
from torchtrack.config.settings import Settings
from torchtrack.core.atomic import check_writable
from torchtrack.core.limits import limits
from torchtrack.errors import ConfigError, MissingFileError, TorchtrackError
from torchtrack.io.reading import Progress
from torchtrack.io.sequence import read_sequence
from torchtrack.run.executor import TaskFailure, Tell, run_tasks
from torchtrack.run.runner import threads
from torchtrack.sim.output import check_output, write
from torchtrack.sim.scenes import SceneConfig
from torchtrack.sim.simulation import simulate

# Progress of a scene is told in steps of this share.
_PROGRESS_STEP = 0.02
_YAML = (".yaml", ".yml")

Told = Callable[[str, float], None]
"""Called with the name of a scene and the share of it that is done."""


class SuiteConfig(Settings):
    """A list of scenes."""

    scenes: tuple[str, ...] = Field(min_length=1, description="YAML files of scenes or of suites; * and ? stand for any text.")


@dataclass(frozen=True)
class Failure:
    """A scene that could not be simulated, and why."""

    name: str
    reason: str


def is_suite(path: Path) -> bool:
    """Whether a path holds several scenes: a folder, a list of scenes, or a scene with variants."""
    return path.is_dir() or not {"scenes", "variants"}.isdisjoint(read_yaml(path))


def scenes_of(path: Path, overrides: Mapping[str, Any] | None = None) -> list[SceneConfig]:
    """All scenes of a suite, each variant as a scene; ``overrides`` (dotted key to value) are laid over every one.

    Raises:
        MissingFileError: if a file that is named is not there.
        ConfigError: if settings are wrong, suites contain one another, or two scenes have the same name.
    """
    scenes = _expanded(path, overrides or {}, ())
    names = [scene.name for scene in scenes]
    if doubles := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}: several scenes are called {', '.join(doubles)}; each becomes a file of its name. Name them differently.")
    return scenes


def _expanded(path: Path, overrides: Mapping[str, Any], within: tuple[Path, ...]) -> list[SceneConfig]:
    path = path.resolve()
    if path in within:
        raise ConfigError(f"{path}: this suite contains itself. Remove it from its list of scenes.")
    inner = partial(_expanded, overrides=overrides, within=(*within, path))
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in _YAML)
        if not files:
            raise MissingFileError(f"the folder {path} holds no scene (.yaml). Check the path.")
        return [scene for file in files for scene in inner(file)]
    values = read_yaml(path)
    if "scenes" not in values:
        variants = values.get("variants") or {}
        if not variants or "variant" in overrides:
            return [load(SceneConfig, path, overrides)]
        return [load(SceneConfig, path, {**overrides, "variant": name}) for name in variants]
    return [scene for pattern in load(SuiteConfig, path).scenes for file in _matching(path.parent, pattern) for scene in inner(file)]


def _matching(folder: Path, pattern: str) -> list[Path]:
    """Files that a pattern names, relative to a folder."""
    try:
        paths = sorted(folder.glob(pattern)) if not Path(pattern).is_absolute() else [Path(pattern)]
    except (ValueError, OSError) as error:
        raise ConfigError(f"{folder}: scenes: '{pattern}' is no pattern of file names ({error}). Correct it.") from error
    if not paths:
        raise MissingFileError(f"scenes: nothing at {folder / pattern}. Check the path.")
    return paths


def is_done(scene: SceneConfig, path: Path) -> bool:
    """Whether a whole sequence of just this scene is there already; settings that its file does not know yet are as by default."""
    try:
        known = SceneConfig.model_validate(read_sequence(path).meta.get("scene")) if path.is_file() else None
    except (TorchtrackError, ValidationError):
        return False
    return known is not None and known.model_dump(mode="json") == scene.model_dump(mode="json")


def simulate_to_file(scene: SceneConfig, path: Path, progress: Progress | None = None, *, preview: bool = False) -> Path:
    """Simulate a scene and write it; with a preview, ``NAME.mp4`` beside it.

    Raises:
        EventDataError: if ``path`` is neither a ``.npz`` nor a ``.h5`` file.
        OutputError: if it cannot be written.
        TorchtrackError: as :func:`torchtrack.sim.simulation.simulate`.
    """
    check_output(path)
    check_writable(path)
    with limits(scene.limits):
        sequence = simulate(scene, progress)
    if preview:
        # What draws pictures loads the whole tracker; those who want none need not wait for it.
        from torchtrack.sim.preview import write_preview

        write_preview(sequence, scene, path.with_suffix(".mp4"))
    return write(sequence, path)


def run_suite(
    scenes: Sequence[SceneConfig],
    folder: Path,
    jobs: int,
    on_progress: Told = lambda name, share: None,
    *,
    preview: bool = False,
    executor: ExecutorName = "local",
) -> list[Failure]:
    """Simulate all scenes that are not there yet into ``folder/NAME.npz``; one that fails does not stop the others.

    Args:
        scenes: each with another name.
        folder: where sequences go; a sequence of the same settings is kept as it is.
        jobs: processes, of one thread each.
        on_progress: for a progress bar.
        preview: whether to write a video of each.
        executor: where they are simulated.
    """
    pending = []
    for scene in scenes:
        if is_done(scene, folder / f"{scene.name}.npz"):
            on_progress(scene.name, 1.0)
        else:
            pending.append(scene)
    failures = []
    targets = [(scene, folder / f"{scene.name}.npz") for scene in pending]
    for number, outcome in run_tasks(
        partial(_simulate_one, preview=preview), targets, executor, jobs, lambda number, share: on_progress(pending[number].name, share)
    ):
        if isinstance(outcome, TaskFailure):
            failures.append(Failure(pending[number].name, outcome.reason))
        on_progress(pending[number].name, 1.0)
    return failures


def _simulate_one(target: tuple[SceneConfig, Path], tell: Tell, preview: bool) -> None:
    """What one process does with one scene."""
    reached = 0.0

    def tell_in_steps(share: float) -> None:
        nonlocal reached
        if share >= reached + _PROGRESS_STEP:
            reached = share
            tell(share)

    with threads(1):
        simulate_to_file(*target, tell_in_steps, preview=preview)

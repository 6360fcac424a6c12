"""Many sequences under many methods: run, measure, compare."""

import csv
import json
import multiprocessing
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtrack.config.evaluate import EvaluateConfig, MethodConfig
from torchtrack.config.run import RunConfig
from torchtrack.errors import ConfigError, EventDataError, MissingFileError, TorchtrackError
from torchtrack.eval.metrics import Metrics, PoseErrors, summarise
from torchtrack.io.atomic import atomic_path
from torchtrack.runner import build_tracker, session_steps, threads
from torchtrack.session import open_session
from torchtrack.sinks.record import Record
from torchtrack.sinks.summary import finite


@dataclass(frozen=True)
class Job:
    """One sequence under one method."""

    path: Path
    method: str
    config: RunConfig


@dataclass(frozen=True)
class ObjectResult:
    """Errors of one object in one sequence under one method, and how long a step took."""

    sequence: str
    object: str
    method: str
    errors: PoseErrors
    metrics: Metrics
    median_step_ms: float

    def as_json(self) -> dict[str, Any]:
        """One entry of ``metrics.json``."""
        names = {"sequence": self.sequence, "object": self.object, "method": self.method}
        return finite({**names, **self.metrics.as_dict(), "median_step_ms": self.median_step_ms})


@dataclass(frozen=True)
class Failure:
    """A sequence that could not be tracked, and why."""

    sequence: str
    method: str
    reason: str


@dataclass(frozen=True)
class Evaluation:
    """Everything that was measured, in the order asked for, and what failed."""

    results: tuple[ObjectResult, ...]
    failures: tuple[Failure, ...]


def find_sequences(paths: Sequence[Path]) -> list[Path]:
    """The ``.npz`` files that are named, or lie in the folders that are named, each once.

    Raises:
        ConfigError: if none is named.
        MissingFileError: if a path is not there, or a folder holds none.
    """
    if not paths:
        raise ConfigError("paths: nothing to evaluate. Name sequences (.npz), or folders of them.")
    found: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise MissingFileError(f"no sequence or folder at {path}. Check the path.")
        inside = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if not inside:
            raise MissingFileError(f"the folder {path} holds no sequence (.npz). Check the path.")
        found.update(dict.fromkeys(inside))
    return list(found)


def evaluate(config: EvaluateConfig, on_done: Callable[[Job], None] = lambda job: None) -> Evaluation:
    """Track every sequence with every method and write ``metrics.json`` and ``errors.csv`` into the output folder.

    A sequence that fails is reported; the others go on.

    Args:
        config: what to do.
        on_done: called after each sequence, for a progress bar.

    Raises:
        ConfigError: if nothing is named.
        MissingFileError: if a path that is named is not there.
    """
    jobs = [Job(path, label, _run_config(path, method, config)) for path in find_sequences(config.paths) for label, method in config.methods.items()]
    outcomes: dict[int, list[ObjectResult] | Failure] = {}
    limits = (config.lost_rotation_deg, config.lost_translation_cm)
    for index, outcome in _outcomes(jobs, limits, config.jobs):
        outcomes[index] = outcome
        on_done(jobs[index])
    ordered = [outcomes[index] for index in range(len(jobs))]
    evaluation = Evaluation(
        tuple(result for outcome in ordered if not isinstance(outcome, Failure) for result in outcome),
        tuple(outcome for outcome in ordered if isinstance(outcome, Failure)),
    )
    write_results(evaluation, config.output)
    return evaluation


def _run_config(path: Path, method: MethodConfig, config: EvaluateConfig) -> RunConfig:
    return RunConfig(source=path, models=config.models, **{name: getattr(method, name) for name in MethodConfig.model_fields})


def _outcomes(jobs: Sequence[Job], limits: tuple[float, float], processes: int) -> Iterator[tuple[int, list[ObjectResult] | Failure]]:
    """The outcome of each job as it comes, with its place."""
    with _executor(min(processes, len(jobs))) as pool:
        futures = {pool.submit(measure, job, limits): index for index, job in enumerate(jobs)}
        for future in as_completed(futures):
            index = futures[future]
            error = future.exception()
            yield index, future.result() if error is None else _failure(jobs[index], error)


def _executor(processes: int) -> Executor:
    """Processes of their own, or one thread where there is nothing to share out."""
    if processes == 1:
        return ThreadPoolExecutor(1)
    # Started afresh, not forked: a fork of a process with threads of its own can hang.
    return ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))


def _failure(job: Job, error: BaseException) -> Failure:
    """What went wrong; an error that is not ours is a bug, and is told with the place where it happened."""
    if isinstance(error, TorchtrackError):
        return Failure(job.path.stem, job.method, str(error))
    if not isinstance(error, Exception):
        raise error
    return Failure(job.path.stem, job.method, "".join(traceback.format_exception(error)))


def measure(job: Job, limits: tuple[float, float]) -> list[ObjectResult]:
    """Track one sequence from its first true poses on and compare every window with the truth.

    Raises:
        EventDataError: if the sequence has no ground truth.
    """
    session = open_session(job.config)
    if any(truth is None for truth in session.ground_truth):
        raise EventDataError(f"'{job.path}' has no ground truth (poses, pose_t) to evaluate against. Use `torchtrack track` for it.")
    record = Record(session.ground_truth)
    with threads(job.config.threads):
        for step in session_steps(session, build_tracker(session, job.config), job.config):
            record.add(step)
    median_step_ms = 1e3 * sorted(record.step_seconds)[len(record.step_seconds) // 2]
    results = []
    for label, of_object in zip(session.labels, record.objects, strict=True):
        if (errors := of_object.errors) is not None:
            results.append(ObjectResult(session.name, label, job.method, errors, summarise(errors, *limits), median_step_ms))
    return results


def write_results(evaluation: Evaluation, folder: Path) -> None:
    """Write ``metrics.json`` (one entry per sequence, object and method) and ``errors.csv`` (one row per window)."""
    with atomic_path(folder / "metrics.json") as path:
        entries = [result.as_json() for result in evaluation.results]
        path.write_text(json.dumps(entries, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_path(folder / "errors.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("sequence", "object", "method", "t_us", "rotation_deg", "translation_cm"))
        for result in evaluation.results:
            errors = result.errors
            for values in zip(errors.t_us.tolist(), errors.rotation_deg.tolist(), errors.translation_cm.tolist(), strict=True):
                rows.writerow((result.sequence, result.object, result.method, values[0], f"{values[1]:.6g}", f"{values[2]:.6g}"))

"""Many sequences under many methods: run, measure, compare."""

import multiprocessing
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchtrack.baselines import unsuitable
from torchtrack.config.evaluate import EvaluateConfig, MethodConfig
from torchtrack.config.run import RunConfig
from torchtrack.errors import EventDataError, TorchtrackError
from torchtrack.eval.compact import compact_report
from torchtrack.eval.grid import Report
from torchtrack.eval.metrics import summarise
from torchtrack.eval.paper import check_cells, paper_report
from torchtrack.eval.results import Evaluation, Failure, NotApplicable, ObjectResult, write_results
from torchtrack.eval.sources import cell_sequences, find_sequences
from torchtrack.quality import Status
from torchtrack.runner import build_tracker, session_steps, threads
from torchtrack.session import Session, open_session
from torchtrack.sim.suite import Told
from torchtrack.sinks.record import Record


@dataclass(frozen=True)
class Job:
    """One sequence under one method."""

    path: Path
    method: str
    config: RunConfig


@dataclass(frozen=True)
class Plan:
    """What is to be done: the jobs, the sequence of each cell of the paper's tables, and scenes that could not be simulated."""

    jobs: tuple[Job, ...]
    cells: Mapping[str, Path]
    failures: tuple[Failure, ...] = ()


# What became of one job: what was measured and what the method is not made for, or why it failed.
Outcome = Sequence[ObjectResult | NotApplicable] | Failure


def plan(config: EvaluateConfig, simulating: Told = lambda name, share: None) -> Plan:
    """Find the sequences; scenes that are not simulated yet are, and ``simulating`` is told how far.

    Raises:
        ConfigError: if nothing is named, or a cell is none of the paper's.
        MissingFileError: if a path that is named is not there.
    """
    check_cells(config.cells)
    found = find_sequences(config.paths) if config.paths or not config.cells else []
    cells, failures = cell_sequences(config.cells, config.cache, config.jobs, simulating)
    failed = {failure.sequence for failure in failures}
    paths = dict.fromkeys([*found, *(path for path in cells.values() if path.stem not in failed)])
    jobs = [Job(path, label, _run_config(path, method, config)) for path in paths for label, method in config.methods.items()]
    return Plan(tuple(jobs), cells, failures)


def evaluate(config: EvaluateConfig, on_done: Callable[[Job], None] = lambda job: None, planned: Plan | None = None) -> Evaluation:
    """Track every sequence with every method; write ``metrics.json``, ``errors.csv`` and the report's tables into the output folder.

    A sequence that fails is reported; the others go on.

    Args:
        config: what to do.
        on_done: called after each sequence, for a progress bar.
        planned: what :func:`plan` made of ``config``, where that was done before.

    Raises:
        ConfigError: if nothing is named.
        MissingFileError: if a path that is named is not there.
    """
    planned = planned or plan(config)
    outcomes: dict[int, Outcome] = {}
    limits = (config.lost_rotation_deg, config.lost_translation_cm)
    for index, outcome in _outcomes(planned.jobs, limits, config.jobs):
        outcomes[index] = outcome
        on_done(planned.jobs[index])
    ordered = [outcomes[index] for index in range(len(planned.jobs))]
    entries = [entry for outcome in ordered if not isinstance(outcome, Failure) for entry in outcome]
    evaluation = Evaluation(
        tuple(entry for entry in entries if isinstance(entry, ObjectResult)),
        tuple(entry for entry in entries if isinstance(entry, NotApplicable)),
        (*planned.failures, *(outcome for outcome in ordered if isinstance(outcome, Failure))),
    )
    write_results(evaluation, config.output)
    if report := report_of(evaluation, config, planned):
        report.write(config.output)
    return evaluation


def report_of(evaluation: Evaluation, config: EvaluateConfig, planned: Plan) -> Report | None:
    """The tables that the settings ask for beside the rows of every sequence; None for none."""
    if config.report == "compact":
        return compact_report(evaluation, tuple(config.methods))
    if config.report == "paper":
        return paper_report(evaluation, config.cells, planned.cells, tuple(config.methods))
    return None


def _run_config(path: Path, method: MethodConfig, config: EvaluateConfig) -> RunConfig:
    return RunConfig(source=path, models=config.models, **{name: getattr(method, name) for name in MethodConfig.model_fields})


def _outcomes(jobs: Sequence[Job], limits: tuple[float, float], processes: int) -> Iterator[tuple[int, Outcome]]:
    """The outcome of each job as it comes, with its place."""
    with _executor(max(1, min(processes, len(jobs)))) as pool:
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


def measure(job: Job, limits: tuple[float, float]) -> list[ObjectResult | NotApplicable]:
    """Track one sequence from its first true poses on and compare every window with the truth.

    Objects that the method is not made for are left out, and told.

    Raises:
        EventDataError: if the sequence has no ground truth.
    """
    session = open_session(job.config)
    if any(truth is None for truth in session.ground_truth):
        raise EventDataError(f"'{job.path}' has no ground truth (poses, pose_t) to evaluate against. Use `torchtrack track` for it.")
    reasons = [unsuitable(job.config.preset, model) for model in session.models]
    left_out = [NotApplicable(session.name, label, job.method, why) for label, why in zip(session.labels, reasons, strict=True) if why]
    fit = [number for number, reason in enumerate(reasons) if reason is None]
    return [*(_track(_only(session, fit), job, limits) if fit else []), *left_out]


def _only(session: Session, numbers: Sequence[int]) -> Session:
    """The session with some of its objects."""
    return replace(
        session,
        labels=tuple(session.labels[number] for number in numbers),
        models=tuple(session.models[number] for number in numbers),
        ground_truth=tuple(session.ground_truth[number] for number in numbers),
        T_cam_obj=session.T_cam_obj[torch.tensor(numbers)],
    )


def _track(session: Session, job: Job, limits: tuple[float, float]) -> list[ObjectResult]:
    record = Record(session.ground_truth)
    with threads(job.config.threads):
        for step in session_steps(session, build_tracker(session, job.config), job.config):
            record.add(step)
    median_step_ms = 1e3 * sorted(record.step_seconds)[len(record.step_seconds) // 2]
    results = []
    for label, of_object in zip(session.labels, record.objects, strict=True):
        if (errors := of_object.errors) is not None:
            status = {Status(number).name: count for number, count in sorted(of_object.statuses.items())}
            results.append(ObjectResult(session.name, label, job.method, errors, summarise(errors, *limits), status, median_step_ms))
    return results

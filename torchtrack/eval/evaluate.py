"""Many sequences under many methods: run, measure, compare."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from torchtrack.baselines import unsuitable
from torchtrack.config.evaluate import EvaluateConfig, MethodConfig
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.atomic import check_writable
from torchtrack.core.limits import limits as file_limits
from torchtrack.core.windows import EventWindow
from torchtrack.errors import EventDataError
from torchtrack.eval.compact import compact_report
from torchtrack.eval.grid import Report, markdown
from torchtrack.eval.journal import Journal, Measured, identity
from torchtrack.eval.marked import check_marks, replace_between
from torchtrack.eval.paper import check_cells, paper_report
from torchtrack.eval.results import Evaluation, Failure, NotApplicable, ObjectResult, write_results
from torchtrack.eval.sources import cell_sequences, find_sequences
from torchtrack.eval.start import StartError, start_angle_deg
from torchtrack.eval.surface_errors import SurfaceErrors, surface_errors
from torchtrack.eval.trial import trial_report
from torchtrack.run.executor import TaskFailure, Tell
from torchtrack.run.executor.groups import run_in_groups
from torchtrack.run.executor.tasks import without_errors
from torchtrack.run.metrics import PoseErrors, summarise
from torchtrack.run.runner import threads
from torchtrack.run.session import open_session
from torchtrack.run.sinks.record import ObjectRecord, Record
from torchtrack.run.stepping import Step, cut_windows
from torchtrack.run.streams import follow
from torchtrack.sim.suite import Told
from torchtrack.tracking.validation.status import Status


@dataclass(frozen=True)
class Job:
    """One run of one sequence under one method."""

    path: Path
    method: str
    config: RunConfig
    start: StartError


@dataclass(frozen=True)
class Plan:
    """What is to be done: the jobs, the sequence of each cell of the paper's tables, and scenes that could not be simulated."""

    jobs: tuple[Job, ...]
    cells: Mapping[str, Path]
    failures: tuple[Failure, ...] = ()


# Between these marks in a Markdown file stands the table of a trial.
_TRIAL_MARK = "TRIAL"
# What became of one job: what was measured and what the method is not made for, or why it failed.
Outcome = Measured | Failure


def plan(config: EvaluateConfig, simulating: Told = lambda name, share: None) -> Plan:
    """Find the sequences; scenes that are not simulated yet are, and ``simulating`` is told how far.

    Raises:
        ConfigError: if nothing is named, or a cell is none of the paper's.
        ConfigError: also if the file of the table has no marks to put it between.
        MissingFileError: if a path that is named is not there.
        OutputError: if the output folder cannot be written into.
    """
    check_cells(config.cells)
    check_writable(config.output / "metrics.json")
    if config.table is not None:
        check_marks(config.table, _TRIAL_MARK)
    searched = find_sequences(config.paths) if config.paths or not config.cells else []
    cells, failures = cell_sequences(config.cells, config.cache, config.jobs, simulating, config.executor)
    failed = {failure.sequence for failure in failures}
    paths = dict.fromkeys([*searched, *(path for path in cells.values() if path.stem not in failed)])
    return Plan(tuple(_jobs(list(paths), config)), cells, failures)


def _jobs(paths: Sequence[Path], config: EvaluateConfig) -> Iterator[Job]:
    """What is to be measured; of a trial, one run of a method after the other, so that what there is so far can be compared."""
    methods = config.methods.items()
    by_method = [(path, label, method) for label, method in methods for path in paths]
    by_sequence = [(path, label, method) for path in paths for label, method in methods]
    for run in range(1, config.runs + 1):
        for path, label, method in by_method if config.report == "trial" else by_sequence:
            yield Job(path, label, _run_config(path, method, config), StartError(start_angle_deg(path.stem, config.start_angles_deg), run))


def evaluate(config: EvaluateConfig, on_done: Callable[[Job], None] = lambda job: None, planned: Plan | None = None) -> Evaluation:
    """Track every sequence with every method; write ``metrics.json``, ``errors.csv`` and the report's tables into the output folder.

    A sequence that fails is reported; the others go on. Until all is done without a failure, and of a trial always, ``outcomes.jsonl``
    beside the results keeps what was measured, for ``config.resume``.

    Args:
        config: what to do.
        on_done: called after each sequence, for a progress bar.
        planned: what :func:`plan` made of ``config``, where that was done before.

    Raises:
        ConfigError: if nothing is named.
        MissingFileError: if a path that is named is not there.
        OutputError: if the output folder cannot be written into.
    """
    planned = planned or plan(config)
    journal = Journal(config.output / "outcomes.jsonl", _limits(config))
    ordered = _measured_once(planned.jobs, config, journal, on_done)
    entries = [entry for outcome in ordered if not isinstance(outcome, Failure) for entry in outcome]
    evaluation = Evaluation(
        tuple(entry for entry in entries if isinstance(entry, ObjectResult)),
        tuple(entry for entry in entries if isinstance(entry, NotApplicable)),
        (*planned.failures, *(outcome for outcome in ordered if isinstance(outcome, Failure))),
    )
    write_results(evaluation, config.output)
    if report := report_of(evaluation, config, planned):
        report.write(config.output)
        if config.table is not None:
            replace_between(config.table, _TRIAL_MARK, markdown(report.grids[0]))
    # A trial may go on with more methods or runs.
    if not evaluation.failures and config.report != "trial":
        journal.remove()
    return evaluation


def _measured_once(jobs: Sequence[Job], config: EvaluateConfig, journal: Journal, on_done: Callable[[Job], None]) -> list[Outcome]:
    """The outcome of every job; what the journal knows is not measured again, where that is asked for."""
    names = [identity(job.path, job.method, job.config, job.start) for job in jobs]
    known = journal.read() if config.resume or config.measured_only else {}
    if config.measured_only:
        return [known[name] for name in names if name in known]
    journal.begin(known)
    outcomes: dict[int, Outcome] = {number: known[name] for number, name in enumerate(names) if name in known}
    for number in outcomes:
        on_done(jobs[number])
    left = [number for number in range(len(jobs)) if number not in outcomes]
    for index, outcome in _outcomes([jobs[number] for number in left], config):
        outcomes[left[index]] = outcome
        if not isinstance(outcome, Failure):
            journal.add(names[left[index]], outcome)
        on_done(jobs[left[index]])
    return [outcomes[number] for number in range(len(jobs))]


def _limits(config: EvaluateConfig) -> tuple[float, float]:
    """From which rotation (degrees) and translation (cm) on a window counts as lost."""
    return config.lost_rotation_deg, config.lost_translation_cm


def report_of(evaluation: Evaluation, config: EvaluateConfig, planned: Plan) -> Report | None:
    """The tables that the settings ask for beside the rows of every sequence; None for none."""
    if config.report == "compact":
        return compact_report(evaluation, tuple(config.methods))
    if config.report == "trial":
        sequences = dict.fromkeys(job.path.stem for job in planned.jobs)
        return trial_report(evaluation, tuple(config.methods), tuple(sequences), _limits(config))
    if config.report == "paper":
        return paper_report(evaluation, config.cells, planned.cells, tuple(config.methods))
    return None


def _run_config(path: Path, method: MethodConfig, config: EvaluateConfig) -> RunConfig:
    return RunConfig(source=path, models=config.models, limits=config.limits, **{name: getattr(method, name) for name in MethodConfig.model_fields})


def _outcomes(jobs: Sequence[Job], config: EvaluateConfig) -> Iterator[tuple[int, Outcome]]:
    """The outcome of each job as it comes, with its number."""
    function = partial(measure, limits=_limits(config))
    alike = [(job.method, job.start.run) for job in jobs]
    for numbers, outcomes in run_in_groups(function, jobs, alike, config.streams, config.executor, config.jobs):
        for number, outcome in zip(numbers, outcomes, strict=True):
            job = jobs[number]
            yield number, Failure(job.path.stem, job.method, outcome.reason) if isinstance(outcome, TaskFailure) else outcome


def measure(jobs: Sequence[Job], tell: Tell, limits: tuple[float, float]) -> list[list[ObjectResult | NotApplicable] | TaskFailure]:
    """Track sequences with one method, as one batch, from their first true poses on, and compare every window with the truth."""
    with threads(jobs[0].config.threads), file_limits(jobs[0].config.limits):
        return without_errors(follow([partial(_Measurement, job, limits) for job in jobs], jobs[0].config))


class _Measurement:
    """Measures one job; objects that the method is not made for are left out, and told.

    Raises:
        EventDataError: if the sequence has no ground truth.
    """

    def __init__(self, job: Job, limits: tuple[float, float]) -> None:
        session = job.start.applied(open_session(job.config))
        if any(truth is None for truth in session.ground_truth):
            raise EventDataError(f"'{job.path}' has no ground truth (poses, pose_t) to evaluate against. Use `torchtrack track` for it.")
        reasons = [unsuitable(job.config.preset, model) for model in session.models]
        self._left_out = [NotApplicable(session.name, label, job.method, why) for label, why in zip(session.labels, reasons, strict=True) if why]
        self.session = session.with_objects([number for number, reason in enumerate(reasons) if reason is None])
        self._record, self._job, self._limits = Record(self.session.ground_truth, self.session.models), job, limits
        # Times of the windows, and the poses of all objects.
        self._t_us: list[Tensor] = []
        self._poses: list[Tensor] = []

    def windows(self, config: WindowConfig) -> Iterator[EventWindow]:
        """The windows of the sequence."""
        return cut_windows(self.session.chunks(), self.session.start_us, config)

    def add(self, step: Step) -> None:
        """Remember one step."""
        self._record.add(step)
        self._t_us.append(step.result.t_us[:1].cpu())
        self._poses.append(step.result.T_cam_obj.cpu())

    def finish(self) -> list[ObjectResult | NotApplicable]:
        """What was measured of each object."""
        records = enumerate(self._record.objects)
        return [*(self._result(number, record, record.errors) for number, record in records if record.errors is not None), *self._left_out]

    def close(self, error: BaseException | None = None) -> None:
        """Nothing is open."""

    def _result(self, number: int, of_object: ObjectRecord, errors: PoseErrors) -> ObjectResult:
        status = {Status(number).name: count for number, count in sorted(of_object.statuses.items())}
        seconds = self._record.step_seconds
        median_step_ms = 1e3 * sorted(seconds)[len(seconds) // 2]
        metrics, unseen_turns = summarise(errors, *self._limits), of_object.axis is not None
        names = self.session.name, self.session.labels[number], self._job.method
        return ObjectResult(*names, errors, metrics, status, median_step_ms, unseen_turns, self._surface(number), run=self._job.start.run)

    def _surface(self, number: int) -> SurfaceErrors | None:
        """What the surface of an object is off by; None where nothing was tracked."""
        truth = self.session.ground_truth[number]
        if truth is None or not self._t_us:
            return None
        t_us = torch.cat(self._t_us)
        covered = truth.covers(t_us)
        return surface_errors(torch.stack(self._poses)[covered, number], truth.at(t_us[covered]), self.session.models[number])

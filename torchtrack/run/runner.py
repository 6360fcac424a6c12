"""Runs, one or many: source → tracker → outputs."""

import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch

from torchtrack.config.executor import ExecutorName
from torchtrack.config.run import RunConfig, TrackingConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch, ForeignEvents, as_batch
from torchtrack.core.limits import limits
from torchtrack.core.windows import clipped
from torchtrack.errors import ConfigError, EventDataError, TorchtrackError
from torchtrack.io import EventSource
from torchtrack.io.event_stream import EventStream
from torchtrack.io.live_source import LiveSource
from torchtrack.io.mending import mended_batches
from torchtrack.io.problems import Problems
from torchtrack.run.executor import TaskFailure, Tell
from torchtrack.run.executor.groups import run_in_groups
from torchtrack.run.executor.tasks import without_errors
from torchtrack.run.interrupt import Interrupt
from torchtrack.run.lost_search import LostSearch
from torchtrack.run.outputs import RunOutputs
from torchtrack.run.refine import Refinement, refined_steps
from torchtrack.run.session import Session
from torchtrack.run.sinks import Sink
from torchtrack.run.sinks.resume import has_begun, is_complete
from torchtrack.run.sinks.summary import RunSummary
from torchtrack.run.smooth import SmoothedObjects
from torchtrack.run.stepping import cut_windows, steps
from torchtrack.run.streams import follow
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker

__all__ = ["run", "run_many", "track"]


def track(
    source: EventSource | Iterable[EventBatch | ForeignEvents],
    tracker: Tracker,
    state: TrackerState,
    window: WindowConfig | None = None,
    problems: Problems | None = None,
) -> Iterator[StepResult]:
    """Track one stream from ``state`` on, one result per window, in constant memory; refined where the tracker's settings say so.

    Refined results come up to 0.6 s late by the preset ``default``: for batches from a camera of your own, take ``causal``, or
    :class:`torchtrack.Stream`. A live source is never held back.

    Args:
        source: a source of events, or batches of them, also of another library; events up to the state's time are passed over. What is wrong
            with the times of batches is mended as for files; what comes late by up to 10 ms is sorted in, what was sent twice or is too
            late is dropped, and where the clock wraps or jumps back, time goes on.
        tracker: the tracker, of one stream.
        state: where it starts, from :meth:`Tracker.init`.
        window: how to cut the stream; as the tracker is configured when not given.
        problems: where it is counted what was wrong with batches; if strict, the first fault is an error. By default a warning tells it.

    Raises:
        EventDataError: if the stream has no events after the state's time, or they are malformed.
    """
    start_us = int(state.t_us[0])
    chunks = source.chunks() if isinstance(source, EventSource) else map(as_batch, source)
    if not isinstance(source, EventStream):
        camera = tracker.cameras[0]
        chunks = mended_batches(chunks, camera.width, camera.height, problems or Problems("the stream", strict=False))
    seen, config = False, window or tracker.config.window
    objects = SmoothedObjects(tracker.centre_obj.double().cpu(), tracker.diameter_m.double().cpu(), tracker.intrinsics.double().cpu())
    taken = steps(cut_windows(clipped(chunks, start_us), start_us, config), tracker, state, LostSearch(tracker))
    refinement = Refinement(objects, tracker.config, tracker.alone)
    for step in taken if isinstance(source, LiveSource) else refined_steps(taken, refinement):
        seen = True
        yield step.result
    if not seen:
        raise EventDataError(f"the stream has no events after {start_us} µs, where tracking starts. Check the start time and the file.")


def run(config: RunConfig, sinks: Sequence[Sink] = (), session: Session | None = None, *, resume: bool = False) -> RunSummary:
    """Track a source and write trajectories, poses, overlay, settings and summary into the output folder, as the run goes on.

    Ctrl-C, SIGTERM and SIGHUP end the run after the window at hand. However a run ends, what was tracked up to there is in the folder, and
    ``summary.json`` says how it ended. An earlier result there has the suffix ``.previous`` until the new run is complete.

    Args:
        config: what to do.
        sinks: further sinks, such as a progress bar; an exception of one ends the run, and is raised again.
        session: what :func:`open_session` made of ``config``, where that was done before.
        resume: go on with the run in the output folder that ended early, from its last pose.

    Raises:
        OutputError: if the folder cannot be written into, or another run does so.
        TorchtrackError: of the kind that fits, if anything that the run needs is missing or wrong.
        OSError: if a file cannot be read.
    """
    with threads(config.threads), limits(config.limits), Interrupt() as interrupt:
        (outcome,) = follow([lambda: RunOutputs(config, interrupt, sinks, session, resume=resume)], config, lambda: interrupt.requested)
    if isinstance(outcome, TorchtrackError | OSError):
        raise outcome
    return outcome


def run_many(
    configs: Sequence[RunConfig], *, streams: int = 1, jobs: int = 1, executor: ExecutorName = "local", resume: bool = False
) -> Iterator[tuple[int, RunSummary | TaskFailure]]:
    """Track many sources as :func:`run` does each; gives the number of each and its summary, or why it failed, as it comes.

    Ctrl-C ends it; what was tracked up to there stays, as in :func:`run`.

    Args:
        configs: one for each source, with a folder of its own for the results.
        streams: so many are tracked as one batch, as far as their tracking settings are the same.
        jobs: processes.
        executor: where they are.
        resume: leave out those that are complete, and go on with those that ended early.

    Raises:
        ConfigError: if ``streams`` is less than one, two results would go to one folder, or a source is live: it would wait for the others.
    """
    if streams < 1:
        raise ConfigError(f"streams: at least one is needed, got {streams}.")
    folders = [config.output for config in configs]
    if doubles := sorted({str(folder) for folder in folders if folders.count(folder) > 1}):
        raise ConfigError(f"the results of several sources would go to {', '.join(doubles)}. Give each a folder of its own.")
    if live := [config.source for config in configs if not isinstance(config.source, Path)]:
        raise ConfigError(f"'{live[0]}' is live, and others would make it wait. Track it alone.")
    alike = [config.model_dump_json(include={*TrackingConfig.model_fields, "threads"}) for config in configs]
    left = [number for number, config in enumerate(configs) if not (resume and is_complete(config.output))]
    tasks = [(configs[number], resume and has_begun(configs[number].output)) for number in left]
    for numbers, outcomes in run_in_groups(_run_group, tasks, [alike[number] for number in left], streams, executor, jobs):
        yield from zip((left[number] for number in numbers), outcomes, strict=True)
        if any(outcome.interrupted for outcome in outcomes if isinstance(outcome, RunSummary)):
            return


def _run_group(tasks: Sequence[tuple[RunConfig, bool]], tell: Tell) -> list[RunSummary | TaskFailure]:
    """Runs that have their tracking settings in common, as one batch; of each, whether it is taken up."""
    (first, _), *_ = tasks
    with threads(first.threads), limits(first.limits), Interrupt() as interrupt:
        outputs = [partial(RunOutputs, config, interrupt, resume=resume) for config, resume in tasks]
        outcomes = without_errors(follow(outputs, first, lambda: interrupt.requested))
    if interrupt.requested and multiprocessing.parent_process() is not None:
        # A process that was told to end, by one that waits for just that.
        raise KeyboardInterrupt
    return outcomes


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let PyTorch use ``count`` threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

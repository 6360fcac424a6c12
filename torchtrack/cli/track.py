"""``torchtrack track``: settings in, one run or many, tables out."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from torchtrack.cli.console import OutputLines, error_console, output_console, tell_failure, tell_warning
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.progress import progress_shown
from torchtrack.config.executor import ExecutorName
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.core.files import naming
from torchtrack.eval.tables import run_headline, run_table
from torchtrack.io.line_file import LineFile
from torchtrack.run.executor import TaskFailure
from torchtrack.run.runner import run, run_many
from torchtrack.run.session import open_session
from torchtrack.run.sinks import Sink
from torchtrack.run.sinks.folder import FIRST_STILL, check_folder
from torchtrack.run.sinks.pose_lines import PoseLines
from torchtrack.run.sinks.progress import ProgressBar
from torchtrack.run.sinks.rerun_log import RerunLog, check_target
from torchtrack.run.sinks.resume import check_resumable, is_complete
from torchtrack.run.sinks.start_support import StartNotice
from torchtrack.run.sinks.summary import ObjectSummary, RunSummary
from torchtrack.run.stage_times import stages_timed
from torchtrack.tracking.validation.status import Status


@dataclass(frozen=True)
class ExtraOutputs:
    """Where a run goes beside its folder.

    Args:
        poses: a file, or ``-`` for standard output, that gets lines of JSON; the summary goes to standard error in the second case.
        rerun: a file for the Rerun viewer (``.rrd``), or ``live`` for the viewer itself.
    """

    poses: str | None = None
    rerun: str | None = None


_NO_EXTRA = ExtraOutputs()
# Which exit code tells of many runs that ended in different ways.
_GRAVEST_FIRST = (ExitCode.INTERRUPTED, ExitCode.FAILED, ExitCode.NOT_TRACKED, ExitCode.DONE)


def track(config_or_source: str, overrides: Mapping[str, Any], extra: ExtraOutputs = _NO_EXTRA, *, resume: bool = False, quiet: bool) -> int:
    """Track one source, or go on with that, show the summary; returns the exit code."""
    with naming(Path(config_or_source)):
        return run_and_show(_run_config(config_or_source, overrides), quiet, resume, extra)


def track_many(
    configs_or_sources: Sequence[str],
    overrides: Mapping[str, Any],
    *,
    streams: int = 1,
    jobs: int = 1,
    executor: ExecutorName = "local",
    resume: bool = False,
    quiet: bool,
) -> int:
    """Track several sources, show the summary of each as it comes; returns the exit code, which is not 0 where one failed.

    With ``resume`` those that are complete are left out, and those that ended early go on.
    """
    configs = [_in_own_folder(_run_config(text, overrides), Path(text).stem) for text in configs_or_sources]
    console, codes = output_console(), [ExitCode.DONE]
    for text in (text for text, config in zip(configs_or_sources, configs, strict=True) if resume and is_complete(config.output)):
        console.print(f"{text}: complete already, left out", markup=False)
    with progress_shown(quiet=quiet) as progress:
        bar = progress.add_task("sources", total=len(configs))
        for number, outcome in run_many(configs, streams=streams, jobs=jobs, executor=executor, resume=resume):
            progress.advance(bar)
            if isinstance(outcome, TaskFailure):
                tell_failure(f"{configs_or_sources[number]}: {outcome.reason}")
                codes.append(ExitCode.FAILED)
            else:
                codes.append(_show_run(console, outcome, configs[number].output))
    return next(code for code in _GRAVEST_FIRST if code in codes)


def _in_own_folder(config: RunConfig, name: str) -> RunConfig:
    return config.model_copy(update={"output": config.output / name})


def _run_config(config_or_source: str, overrides: Mapping[str, Any]) -> RunConfig:
    """The settings of a run, from a YAML file or for a source that needs none."""
    if Path(config_or_source).suffix.lower() in (".yaml", ".yml"):
        return load(RunConfig, Path(config_or_source), overrides)
    return load(RunConfig, None, {"source": CommandLineText(config_or_source), **overrides})


def run_and_show(config: RunConfig, quiet: bool, resume: bool = False, extra: ExtraOutputs = _NO_EXTRA) -> int:
    """One run, and its table; returns the exit code."""
    only_poses = extra.poses == "-"
    console = error_console() if only_poses else output_console()
    if resume:
        check_resumable(config)
    check_folder(config.output)
    if extra.rerun is not None:
        check_target(extra.rerun)
    sinks: list[Sink] = []
    with ExitStack() as stack:
        progress = stack.enter_context(progress_shown(quiet=quiet or only_poses))
        opening = progress.add_task(f"opening {config.source}", total=None)
        session = open_session(config)
        progress.remove_task(opening)
        if config.compiled and not quiet:
            progress.console.print("compiling the tracker, which takes a minute or two for the first time")
        if not (quiet or only_poses):
            sinks.append(ProgressBar(progress, session))
        if not resume:
            tell = partial(progress.console.print, markup=False, highlight=False, soft_wrap=True)
            sinks.append(StartNotice(session.labels, tell, config.output / FIRST_STILL, only_doubts=quiet or only_poses))
        if extra.poses is not None:
            lines = stack.enter_context(closing(OutputLines() if only_poses else LineFile(Path(extra.poses))))
            sinks.append(PoseLines(lines, session.labels))
        if extra.rerun is not None:
            # What is compiled as a whole has no stages to time.
            stack.enter_context(nullcontext() if config.compiled else stages_timed(torch.device(config.device)))
            sinks.append(RerunLog(extra.rerun, session))
        summary = run(config, sinks, session, resume=resume)
    return _show_run(console, summary, config.output)


def _show_run(console: Console, summary: RunSummary, output: Path) -> ExitCode:
    """Show what came of a run; returns the exit code."""
    console.print(run_headline(summary))
    console.print(run_table(summary))
    if summary.joined_windows or summary.dropped_windows:
        left_out = f"{summary.dropped_windows} were dropped, {summary.dropped_events} events left out"
        console.print(f"events came too fast: {summary.joined_windows} windows were joined with the next, {left_out}")
    console.print(f"Results are in {output}")
    for label, share in summary.not_tracked.items():
        tell_warning(f"'{label}' was tracked in {100 * share:.1f} % of the windows. {_what_to_try(summary.objects[label], output)}")
    if summary.interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.NOT_TRACKED if summary.not_tracked else ExitCode.DONE


def _what_to_try(of_object: ObjectSummary, output: Path) -> str:
    """What helps an object that was not tracked."""
    if of_object.status.get(Status.TOO_FEW_EVENTS.name, 0) > sum(of_object.status.values()) / 2:
        return "Most windows had too few events on it: try longer ones (tracker.window.duration_us), and see whether it moves at all."
    if of_object.status.get(Status.OUT_OF_VIEW.name, 0) > sum(of_object.status.values()) / 2:
        return f"It was out of view: check the initial pose, its time and the camera; {output / FIRST_STILL} shows the start."
    return (
        f"Look at {output / FIRST_STILL}: does the contour lie on the events? If not, `torchtrack pose` finds a pose (--points, --near, --search); "
        "if it does, check the size of the model (`torchtrack model`) and the calibration; of a textured object, also the polarity (events.polarity)."
    )

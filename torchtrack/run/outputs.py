"""Everything that one run writes: what follows its session step by step."""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchtrack.config.load import as_yaml
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.atomic import writing
from torchtrack.core.windows import EventWindow
from torchtrack.errors import EventDataError, MissingFileError, OutputError, TorchtrackError, UnknownFormatError
from torchtrack.io.keep_up import KeepUp
from torchtrack.io.ros_live import RosSource
from torchtrack.run.interrupt import Interrupt
from torchtrack.run.session import Session, open_session
from torchtrack.run.sinks import Sink
from torchtrack.run.sinks.alignment import AlignmentRecord
from torchtrack.run.sinks.folder import CONFIG, FIRST_STILL, SUMMARY, OutputFolder
from torchtrack.run.sinks.overlay import FirstStill, Overlay
from torchtrack.run.sinks.poses import PoseFiles
from torchtrack.run.sinks.record import Record
from torchtrack.run.sinks.resume import check_resumable, take_up
from torchtrack.run.sinks.ros_bag import PoseBag
from torchtrack.run.sinks.ros_publisher import RosPublisher
from torchtrack.run.sinks.summary import Ended, Facts, RunSummary, summarise_run, write_summary
from torchtrack.run.stepping import Step, cut_windows


class RunOutputs:
    """Writes trajectories, poses, overlay, settings and summary into the output folder while the run goes on.

    Args:
        config: of the run.
        interrupt: whether it is to end early.
        sinks: further sinks.
        session: what :func:`open_session` made of ``config``, where that was done before.
        resume: take up the run that the folder holds.

    Raises:
        OutputError: if the folder cannot be written into, or another run does so.
        MissingFileError, ConfigError: if there is no run to take up with these settings.
        TorchtrackError: as :func:`open_session`.
    """

    def __init__(
        self, config: RunConfig, interrupt: Interrupt, sinks: Sequence[Sink] = (), session: Session | None = None, *, resume: bool = False
    ) -> None:
        self._config, self._interrupt, self._further, self._resumes = config, interrupt, sinks, resume
        self._begun_s = time.perf_counter()
        self._keep_up: KeepUp | None = None
        self._sinks: list[Sink] = []
        self._at_work: Sink | None = None
        self._begun = self._done = False
        self._resumed_us: int | None = None
        if resume:
            check_resumable(config)
        with ExitStack() as opening:
            self._folder = opening.enter_context(closing(OutputFolder(config.output)))
            self.session = session or open_session(config)
            self._known = _known_facts(config)
            self._record = Record(self.session.ground_truth, self.session.models)
            if resume:
                self._take_up()
            self._open = opening.pop_all()
        # The sinks; they open with the first window.
        self._writing = ExitStack()

    def _take_up(self) -> None:
        """Go on from the last pose of the earlier part of the run, where it has any."""
        earlier = take_up(self._config.output, self.session.labels)
        if len(earlier.t_us):
            self._record.resume(earlier, self.session.start_us)
            self._resumed_us = int(earlier.t_us[-1])
            self.session = replace(self.session, T_cam_obj=earlier.T_cam_obj[-1], start_us=self._resumed_us)

    def windows(self, config: WindowConfig) -> Iterator[EventWindow]:
        """The windows of the session; those of a live one that come too fast are joined, and it ends at an interrupt."""
        windows = cut_windows(self.session.chunks(), self.session.start_us, config)
        self._keep_up = self.session.keep_up(windows)
        return self._beginning(self._keep_up.until(lambda: self._interrupt.requested) if self._keep_up else windows)

    def _beginning(self, windows: Iterator[EventWindow]) -> Iterator[EventWindow]:
        """The same windows; the files are made when the first one is there."""
        for window in windows:
            if not self._begun:
                self._begin()
            yield window

    def _begin(self) -> None:
        """Make the files, once there is something to track."""
        config, session, folder = self._config, self.session, self._folder.path
        if not self._resumes:
            self._folder.set_aside()
        self._begun = True
        write_summary(folder / SUMMARY, self._summary("running", ""), room_for_end=True)
        with writing(folder / CONFIG):
            (folder / CONFIG).write_bytes(as_yaml(config).encode("utf-8", "backslashreplace"))
        self._open_sink(self._record)
        self._open_sink(PoseFiles(folder, session.labels, self._record))
        part = "" if self._resumed_us is None else f"_from_{self._resumed_us}us"
        if self._resumed_us is None:
            self._open_sink(FirstStill(folder / FIRST_STILL, session, config.tracker))
        if config.overlay.enabled:
            self._open_sink(Overlay(folder / f"overlay{part}.mp4", session, config.overlay, config.tracker))
        if config.ros.bag:
            self._open_sink(PoseBag(folder / f"poses{part}.mcap", session.labels))
        if isinstance(session.live, RosSource):
            self._open_sink(RosPublisher(session.live, session.labels))
        if config.alignment:
            self._open_sink(AlignmentRecord(session))
        for sink in self._further:
            self._open_sink(sink)

    def _open_sink(self, sink: Sink) -> None:
        self._sinks.append(self._writing.enter_context(closing(sink)))

    def add(self, step: Step) -> None:
        """Write one step; a sink that raised an error is given no more."""
        if self._at_work is not None:
            self._sinks.remove(self._at_work)
        for sink in tuple(self._sinks):
            self._at_work = sink
            sink.add(step)
        self._at_work = None

    def finish(self) -> RunSummary:
        """Complete all files.

        Raises:
            EventDataError: if there was no window.
            OutputError: if a file cannot be written.
        """
        if not self._begun:
            raise EventDataError(f"'{self.session.name}': not one window was tracked.")
        self._writing.close()
        stopped = self._interrupt.requested
        summary = self._summary("interrupted" if stopped else "completed", self._interrupt.reason)
        write_summary(self._folder.path / SUMMARY, summary)
        self._done = True
        if not stopped:
            self._folder.drop_previous()
        return summary

    def close(self, error: BaseException | None = None) -> None:
        """Leave the folder; where ``error`` has ended the run, with a summary that says so."""
        with self._open:
            if error is not None and self._begun and not self._done:
                self._done = True
                self._fail(error)

    def _fail(self, error: BaseException) -> None:
        """Close the files, and write the summary; that they cannot be written is not told above what ended the run."""
        message = str(error) if isinstance(error, TorchtrackError) else f"{type(error).__name__}: {error}".removesuffix(": ")
        try:
            with suppress(OutputError):
                self._writing.close()
        finally:
            with suppress(OutputError):
                ended: Ended = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                write_summary(self._folder.path / SUMMARY, self._summary(ended, message))

    def _summary(self, ended: Ended, message: str) -> RunSummary:
        wall_s = time.perf_counter() - self._begun_s
        facts = Facts(ended, message, wall_s, self._config.device, self._resumed_us, self._further_facts())
        summary = summarise_run(self.session.name, self.session.labels, self._record, facts).with_problems(self.session.problems)
        if self._keep_up:
            waiting = self._keep_up.waiting
            joined, dropped = waiting.joined_windows, waiting.dropped_windows
            return replace(summary, joined_windows=joined, dropped_windows=dropped, dropped_events=waiting.dropped_events)
        return summary

    def _further_facts(self) -> dict[str, dict[str, Any]]:
        """By label: what optional sinks measured, and what is known from elsewhere."""
        facts = {label: dict(self._known) for label in self.session.labels}
        for sink in self._sinks:
            if isinstance(sink, AlignmentRecord):
                facts = {label: {**facts_of_object, **sink.facts()[label]} for label, facts_of_object in facts.items()}
        return facts


def _known_facts(config: RunConfig) -> dict[str, Any]:
    """What is known of every object from elsewhere: the rotation that it should have."""
    if config.reference_angular_velocity is None:
        return {}
    return {"reference_angular_velocity": read_numbers(config.reference_angular_velocity, 3)}


def read_numbers(path: Path, count: int) -> list[float]:
    """The numbers of a small text file.

    Raises:
        MissingFileError: if it is not there.
        UnknownFormatError: if it does not hold ``count`` numbers and nothing else.
    """
    if not path.is_file():
        raise MissingFileError(f"no file at {path}. Check the path.")
    words = path.read_text(encoding="utf-8", errors="replace").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise UnknownFormatError(f"'{path}' must hold {count} numbers, got '{' '.join(words)[:60]}'.")
    return numbers

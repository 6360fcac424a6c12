"""Everything that one run writes: what follows its session step by step."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchtrack.config.load import as_yaml
from torchtrack.config.run import RunConfig
from torchtrack.errors import EventDataError, MissingFileError, UnknownFormatError
from torchtrack.events import EventWindow
from torchtrack.interrupt import Interrupt
from torchtrack.io.keep_up import KeepUp
from torchtrack.session import Session, open_session
from torchtrack.sinks import Sink
from torchtrack.sinks.alignment import AlignmentRecord
from torchtrack.sinks.folder import output_folder
from torchtrack.sinks.overlay import Overlay
from torchtrack.sinks.poses import PoseFiles
from torchtrack.sinks.record import Record
from torchtrack.sinks.summary import RunSummary, summarise_run
from torchtrack.stepping import Step, cut_windows
from torchtrack.window_length import WindowLength

OUTPUT_FILES = ("trajectory_*.tum", "poses.csv", "config.yaml", "summary.json", "overlay*.mp4", "overlay*.png")


class RunOutputs:
    """Writes trajectories, poses, overlay, settings and summary into the output folder: all of it, or nothing.

    Args:
        config: of the run.
        interrupt: whether it is to end early.
        sinks: further sinks.
        session: what :func:`open_session` made of ``config``, where that was done before.
    """

    def __init__(self, config: RunConfig, interrupt: Interrupt, sinks: Sequence[Sink] = (), session: Session | None = None) -> None:
        self.session = session or open_session(config)
        self._config, self._interrupt, self._further = config, interrupt, sinks
        self._keep_up: KeepUp | None = None
        self._record = Record(self.session.ground_truth, self.session.models)
        self._begun = time.perf_counter()
        # The files, and within them the sinks that write them; both open with the first step.
        self._files, self._writing = ExitStack(), ExitStack()
        self._folder: Path | None = None
        self._sinks: list[Sink] = []

    def windows(self, length: WindowLength) -> Iterator[EventWindow]:
        """The windows of the session; those of a live one that come too fast are joined, and it ends at an interrupt."""
        windows = cut_windows(self.session.chunks(), self.session.start_us, length)
        self._keep_up = self.session.keep_up(windows)
        return self._keep_up.until(lambda: self._interrupt.requested) if self._keep_up else windows

    def add(self, step: Step) -> None:
        """Write one step."""
        if self._folder is None:
            self._folder = self._opened()
        for sink in self._sinks:
            sink.add(step)

    def _opened(self) -> Path:
        config, session = self._config, self.session
        folder = self._files.enter_context(output_folder(config.output, OUTPUT_FILES))
        self._files.enter_context(self._writing)
        own: list[Sink] = [self._record, PoseFiles(folder, session.labels, self._record)]
        own += [Overlay(folder, session, config.overlay, config.tracker)] if config.overlay.enabled else []
        own += [AlignmentRecord(session)] if config.alignment else []
        self._sinks = [self._writing.enter_context(closing(sink)) for sink in (*own, *self._further)]
        return folder

    def finish(self) -> RunSummary:
        """Put all files in place.

        Raises:
            EventDataError: if there was no step.
        """
        if self._folder is None:
            raise EventDataError(f"'{self.session.name}': not one window was tracked.")
        self._writing.close()
        summary = summarise_run(
            self.session.name,
            self.session.labels,
            self._record,
            wall_s=time.perf_counter() - self._begun,
            device=self._config.device,
            interrupted=self._interrupt.requested,
            more=self._further_facts(),
        )
        summary = summary.with_problems(self.session.problems)
        if self._keep_up:
            waiting = self._keep_up.waiting
            joined, dropped = waiting.joined_windows, waiting.dropped_windows
            summary = replace(summary, joined_windows=joined, dropped_windows=dropped, dropped_events=waiting.dropped_events)
        (self._folder / "config.yaml").write_text(as_yaml(self._config), encoding="utf-8")
        text = json.dumps(summary.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
        (self._folder / "summary.json").write_text(f"{text}\n", encoding="utf-8")
        self._files.close()
        return summary

    def close(self) -> None:
        """Take away what was not finished."""
        with suppress(_NotFinishedError), self._files:
            raise _NotFinishedError

    def _further_facts(self) -> dict[str, dict[str, Any]]:
        """By label: what optional sinks measured, and the rotation that is known from elsewhere."""
        facts: dict[str, dict[str, Any]] = {label: {} for label in self.session.labels}
        if self._config.reference_angular_velocity is not None:
            known = {"reference_angular_velocity": read_numbers(self._config.reference_angular_velocity, 3)}
            facts = {label: {**found, **known} for label, found in facts.items()}
        for sink in self._sinks:
            if isinstance(sink, AlignmentRecord):
                facts = {label: {**found, **sink.facts()[label]} for label, found in facts.items()}
        return facts


class _NotFinishedError(Exception):
    """Never seen outside: it has the files taken away."""


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

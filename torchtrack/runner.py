"""One run: source → tracker → sinks."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchtrack.baselines import tracker_class
from torchtrack.config.load import as_yaml
from torchtrack.config.run import RunConfig, TrackingConfig
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.events import EventWindow
from torchtrack.interrupt import Interrupt
from torchtrack.session import Session, open_session
from torchtrack.sinks import Sink
from torchtrack.sinks.alignment import AlignmentRecord
from torchtrack.sinks.folder import output_folder
from torchtrack.sinks.overlay import Overlay
from torchtrack.sinks.poses import PoseFiles
from torchtrack.sinks.record import Record
from torchtrack.sinks.summary import RunSummary, summarise_run
from torchtrack.stepping import Step, cut_windows, steps, track
from torchtrack.tracker import Tracker

__all__ = ["build_tracker", "run", "session_steps", "track"]

OUTPUT_FILES = ("trajectory_*.tum", "poses.csv", "config.yaml", "summary.json", "overlay*.mp4", "overlay*.png")


def build_tracker(session: Session, config: TrackingConfig) -> Tracker:
    """The tracker of a session's objects, of the kind that the preset is for, on the configured device.

    Raises:
        ConfigError: if the device is not there.
        ModelError: if the method cannot track one of the objects.
    """
    if config.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device: '{config.device}' was asked for, but PyTorch sees no CUDA device. Use cpu, or a CUDA build of torch.")
    tracker = tracker_class(config.preset)(list(session.models), session.camera, config.tracker, dtype=getattr(torch, config.dtype))
    return tracker.to(config.device)


def session_steps(session: Session, tracker: Tracker, config: TrackingConfig, windows: Iterator[EventWindow] | None = None) -> Iterator[Step]:
    """Track a session from its initial poses on, one step per window; ``windows``: where they do not come from the session."""
    state = tracker.init(session.T_cam_obj.to(config.device), session.start_us)
    return steps(windows or cut_windows(session.chunks(), config.tracker.window, session.start_us), tracker, state)


def run(config: RunConfig, sinks: Sequence[Sink] = (), session: Session | None = None) -> RunSummary:
    """Track a source and write trajectories, poses, overlay, settings and summary into the output folder.

    Ctrl-C ends the run after the window at hand; the outputs are complete up to there. On an error nothing is written.

    Args:
        config: what to do.
        sinks: further sinks, such as a progress bar.
        session: what :func:`open_session` made of ``config``, where that was done before.

    Raises:
        TorchtrackError: of the kind that fits, if anything that the run needs is missing or wrong.
    """
    session = session or open_session(config)
    tracker = build_tracker(session, config)
    record = Record(session.ground_truth)
    begun = time.perf_counter()
    with threads(config.threads), output_folder(config.output, OUTPUT_FILES) as folder, Interrupt() as interrupt:
        with ExitStack() as stack:
            own: list[Sink] = [record, PoseFiles(folder, session.labels, record), *_optional_sinks(folder, session, config)]
            every = [stack.enter_context(closing(sink)) for sink in (*own, *sinks)]
            keep_up = session.keep_up(config.tracker.window)
            windows = keep_up.until(lambda: interrupt.requested) if keep_up else None
            for step in session_steps(session, tracker, config, windows):
                for sink in every:
                    sink.add(step)
                if interrupt.requested:
                    break
        summary = summarise_run(
            session.name,
            session.labels,
            record,
            wall_s=time.perf_counter() - begun,
            device=config.device,
            interrupted=interrupt.requested,
            more=_further_facts(config, session.labels, own),
        )
        if keep_up:
            summary = replace(summary, dropped_windows=keep_up.dropped_windows, dropped_events=keep_up.dropped_events)
        (folder / "config.yaml").write_text(as_yaml(config), encoding="utf-8")
        write_json(folder / "summary.json", summary.as_json())
    return summary


def _optional_sinks(folder: Path, session: Session, config: RunConfig) -> list[Overlay | AlignmentRecord]:
    """The sinks that can be switched on and off."""
    overlay = [Overlay(folder, session, config.overlay)] if config.overlay.enabled else []
    return [*overlay, *([AlignmentRecord(session)] if config.alignment else [])]


def _further_facts(config: RunConfig, labels: Sequence[str], sinks: Sequence[Sink]) -> dict[str, dict[str, Any]]:
    """By label: what optional sinks measured, and the rotation that is known from elsewhere."""
    facts: dict[str, dict[str, Any]] = {label: {} for label in labels}
    if config.reference_angular_velocity is not None:
        known = {"reference_angular_velocity": read_numbers(config.reference_angular_velocity, 3)}
        facts = {label: {**found, **known} for label, found in facts.items()}
    for sink in sinks:
        if isinstance(sink, AlignmentRecord):
            facts = {label: {**found, **sink.facts()[label]} for label, found in facts.items()}
    return facts


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


def write_json(path: Path, value: Any) -> None:
    """Write plain values as JSON for people to read."""
    path.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let PyTorch use ``count`` threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

"""A finished run shown again in the Rerun viewer: poses from its folder, events from its recording, the contours at these poses."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.events import is_live
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.io.reading import Progress
from torchtrack.report.finished import FinishedRun, ObjectTrack
from torchtrack.run.session import Session, open_session
from torchtrack.run.sinks.folder import CONFIG, POSES
from torchtrack.run.sinks.moment import Moment, ObjectMoment, VisibleContour
from torchtrack.run.sinks.rerun_log import RerunLog, check_target
from torchtrack.run.streams import build_tracker


def show_run(run: FinishedRun, target: str, source: Path | None = None, progress: Progress | None = None) -> None:
    """Log a finished run for the viewer.

    Args:
        run: its folder, read.
        target: ``live`` for the viewer itself, or the file to write (``.rrd``).
        source: where the recording is now, if not where it was.
        progress: called with the share of the windows that is done.

    Raises:
        MissingFileError: if the recording, or another file that the run was given, is not there any more.
        ConfigError, OutputError, MissingExtraError: as :func:`torchtrack.run.sinks.rerun_log.check_target`; also for a run of a live source.
        UnknownFormatError: if the folder's tables do not fit its settings.
        TorchtrackError: as :func:`torchtrack.run.session.open_session`.
    """
    check_target(target)
    config = _config(run, source)
    session = _session(run, config)
    tracks = _tracks(run, session)
    with closing(RerunLog(target, session)) as log:
        for number, moment in enumerate(moments(tracks, session, config), 1):
            log.show(moment)
            if progress is not None:
                progress(number / len(tracks[0].t_us))


def moments(tracks: Sequence[ObjectTrack], session: Session, config: RunConfig) -> Iterator[Moment]:
    """What is shown of each window: ``tracks`` are those of the session's objects, in their order."""
    tracker = build_tracker([session], config)
    ends_us = tracks[0].t_us.tolist()
    for number, (t_us, events) in enumerate(zip(ends_us, batches_up_to(session.chunks(), ends_us), strict=True)):
        poses: Float[Tensor, "b 4 4"] = torch.stack([torch.from_numpy(track.T_cam_obj[number]) for track in tracks])
        with torch.inference_mode():
            contours = tracker.objects.contours(poses.to(tracker.intrinsics.dtype), config.tracker.contours)
        objects = [
            ObjectMoment(
                T_cam_obj=poses[index],
                status=int(track.status[number]),
                quality=float(track.quality[number]),
                std=(float(track.std[number, 0]), float(track.std[number, 1])),
                contour=VisibleContour.of_object(contours, index),
            )
            for index, track in enumerate(tracks)
        ]
        yield Moment(t_us, events, objects)


def batches_up_to(chunks: Iterable[EventBatch], ends_us: Sequence[int]) -> Iterator[EventBatch]:
    """The events up to each of some times, after the one before it; ``ends_us`` increase."""
    more, left = iter(chunks), EventBatch.empty()
    for end_us in ends_us:
        while (len(left) == 0 or int(left.t_us[-1]) <= end_us) and (chunk := next(more, None)) is not None:
            left = concatenate([left, chunk]) if len(left) else chunk
        cut = int(torch.searchsorted(left.t_us, end_us, right=True))
        yield left[:cut]
        left = left[cut:]


def _config(run: FinishedRun, source: Path | None) -> RunConfig:
    """The settings of the run, on the CPU and from another recording where one is given."""
    moved = {} if source is None else {"source": CommandLineText(source)}
    config = load(RunConfig, run.folder / CONFIG, {"device": "cpu", "compiled": False, **moved})
    if is_live(config.source):
        raise ConfigError(
            f"'{run.folder}' was tracked live from '{config.source}', and its events were not kept. Name a recording of them with --source FILE, "
            "or have plots alone: --plots DIR."
        )
    return config


def _session(run: FinishedRun, config: RunConfig) -> Session:
    try:
        return open_session(config)
    except MissingFileError as error:
        raise MissingFileError(
            f"'{run.folder}' cannot be shown as it was tracked: {error} Put the file back; or say where the recording is now, with --source FILE; "
            f"or correct the path of another file in '{run.folder / CONFIG}'. Plots need the folder alone: --plots DIR."
        ) from error


def _tracks(run: FinishedRun, session: Session) -> list[ObjectTrack]:
    """What the run's table says of each object of the session, as far as all of them go."""
    by_label = {track.label: track for track in run.tracks}
    if missing := [label for label in session.labels if label not in by_label]:
        raise UnknownFormatError(f"'{run.folder / POSES}' has no poses of {', '.join(missing)}. Track again.")
    tracks = [by_label[label] for label in session.labels]
    # A run that was killed may have written the last window of some objects alone.
    whole = min(len(track.t_us) for track in tracks)
    return [track.first(whole) for track in tracks]

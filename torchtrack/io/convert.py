"""From one file of events to another, exactly: the same events in the same order, to the µs."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from torchtrack.config.formats import OutputFormat
from torchtrack.core.atomic import check_other_file, temporary_folder, writing
from torchtrack.core.events import EventBatch
from torchtrack.errors import UnknownFormatError
from torchtrack.io.container import ContainerWriter, is_container, read_source
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, EventSource
from torchtrack.io.formats import Input
from torchtrack.io.npz import keys_of, open_archive, stream_array
from torchtrack.io.problems import Problems
from torchtrack.io.reading import Progress, Reading
from torchtrack.io.sequence import is_sequence, read_sequence
from torchtrack.io.sequence_arrays import sequence_arrays
from torchtrack.io.sequence_types import Sequence
from torchtrack.io.writers.aedat4 import Aedat4Writer
from torchtrack.io.writers.base import EventWriter
from torchtrack.io.writers.csv_text import CsvWriter
from torchtrack.io.writers.evt2 import Evt2Writer
from torchtrack.io.writers.evt3 import Evt3Writer
from torchtrack.io.writers.hdf5 import Hdf5Writer
from torchtrack.io.writers.npz import NpzWriter

WRITERS: dict[str, Callable[[Path, int, int], EventWriter]] = {
    "evt2": Evt2Writer,
    "evt3": Evt3Writer,
    "aedat4": Aedat4Writer,
    "dsec": Hdf5Writer,
    "npz": NpzWriter,
    "csv": CsvWriter,
}
_BY_SUFFIX: dict[str, OutputFormat] = {".raw": "evt3", ".aedat4": "aedat4", ".h5": "dsec", ".hdf5": "dsec", ".npz": "npz", ".csv": "csv"}
_SOURCE_TYPE: np.dtype[Any] = np.dtype(np.int16)


@dataclass(frozen=True)
class Conversion:
    """What was written: the format, how many events, and what was wrong with the input."""

    format: OutputFormat
    count: int
    problems: Problems | None


def convert(
    source: str | os.PathLike[str] | Input,
    target: str | os.PathLike[str],
    format: OutputFormat | None = None,
    progress: Progress | None = None,
) -> Conversion:
    """Write the events of one file into another, and all else of a sequence where both are sequences.

    The target appears whole or not at all. A sequence (events with camera, models and truth) stays one in ``.npz`` and
    HDF5; other formats take its events alone.

    Args:
        source: the file to read; an :class:`~torchtrack.io.formats.Input` also says how.
        target: the file to write.
        format: its format; by default as its suffix says: ``.raw`` is EVT3, ``.h5`` a sequence if the source is one, else
            the layout of DSEC.
        progress: called with the share of the input that is done.

    Raises:
        UnknownFormatError: if the format is not known, or cannot hold what it should.
        OutputError: if the target is the source, or cannot be written.
        TorchtrackError: what reading or writing raises.
    """
    file, target = source if isinstance(source, Input) else Input(Path(source)), Path(target)
    check_other_file(file.path, target)
    # Where its events are from is copied beside them: none may be left out, nor change places.
    sequence = read_sequence(file.path, strict=True, choices=file.choices) if is_sequence(file.path) else None
    chosen = _format(target, format, sequence is not None)
    events: EventSource = sequence.events if sequence else file.open()
    chunks = _shown(events, progress)
    with temporary_folder(target) as folder, writing(target):
        written = folder / target.name
        if sequence is not None and chosen in ("npz", "sequence"):
            count = _write_sequence(sequence, chunks, file.path, written, chosen)
        else:
            with closing(WRITERS[chosen](written, events.width, events.height)) as writer:
                count = _copy(chunks, writer.write)
        # The file that names the others comes last: whoever sees it finds them.
        for made in sorted((path for path in written.parent.iterdir() if path.is_file()), key=lambda path: path == written):
            made.replace(target.parent / made.name)
    return Conversion(chosen, count, getattr(events, "problems", None))


def _format(target: Path, given: OutputFormat | None, is_whole: bool) -> OutputFormat:
    """The format to write; ``is_whole``: the source is a sequence."""
    chosen = given or _BY_SUFFIX.get(target.suffix.lower())
    if chosen is None:
        raise UnknownFormatError(
            f"the suffix of '{target}' says no format that can be written. Use {', '.join(_BY_SUFFIX)}, or choose a format: "
            f"{', '.join(get_args(OutputFormat))}."
        )
    if chosen == "sequence" and not is_whole:
        raise UnknownFormatError("a sequence has a camera and objects, but the input holds events alone. Choose the format dsec.")
    return "sequence" if given is None and chosen == "dsec" and is_whole else chosen


def _shown(events: EventSource, progress: Progress | None) -> Iterator[EventBatch]:
    """All events, with word of how far they are read."""
    reading: Reading | None = getattr(events, "reading", None)
    for chunk in events.chunks():
        yield chunk
        if progress is not None and reading is not None and reading.share is not None:
            progress(reading.share)


def _copy(chunks: Iterable[EventBatch], write: Callable[[Any], None]) -> int:
    count = 0
    for chunk in chunks:
        write(chunk)
        count += len(chunk)
    return count


def _write_sequence(sequence: Sequence, chunks: Iterable[EventBatch], source: Path, target: Path, chosen: OutputFormat) -> int:
    """Write a whole sequence; its models are put beside an ``.npz``."""
    origins = _origins(source)
    first = next(origins, None)
    if chosen == "sequence":
        container = ContainerWriter(target, sequence.camera, sequence.objects, sequence.meta, sequence.extra)
        with closing(container):
            return _copy_annotated(chunks, container.write, container.annotate, first, origins)
    arrays = sequence_arrays(sequence, target.stem)
    columns = {} if first is None else {"source": _SOURCE_TYPE}
    npz = NpzWriter(target, sequence.camera.width, sequence.camera.height, arrays, columns)
    with closing(npz):
        count = _copy_annotated(chunks, npz.write, lambda values: npz.annotate("source", values), first, origins)
    for obj, mesh_file in zip(sequence.objects, arrays["mesh_files"].tolist(), strict=True):
        shutil.copyfile(obj.mesh_path, target.with_name(mesh_file))
        if obj.textured_path is not None:
            shutil.copyfile(obj.textured_path, target.with_name(f"{target.stem}_{obj.label}_textured.glb"))
    return count


def _copy_annotated(
    chunks: Iterable[EventBatch],
    write: Callable[[Any], None],
    annotate: Callable[[np.ndarray], None],
    first: np.ndarray | None,
    rest: Iterable[np.ndarray],
) -> int:
    """Copy events, and with each batch where its events are from."""
    count, waiting, more = 0, first, iter(rest)
    for chunk in chunks:
        write(chunk)
        count += len(chunk)
        while waiting is not None and len(waiting) < len(chunk) and (part := next(more, None)) is not None:
            waiting = np.concatenate([waiting, part])
        if waiting is not None:
            annotate(waiting[: len(chunk)])
            waiting = waiting[len(chunk) :]
    return count


def _origins(path: Path) -> Iterator[np.ndarray]:
    """Where the events of a sequence are from, in parts; nothing where that is not stored."""
    if is_container(path):
        yield from read_source(path, DEFAULT_CHUNK_EVENTS)
        return
    with open_archive(path) as archive:
        if "source" in keys_of(archive):
            yield from stream_array(archive, "source", path, DEFAULT_CHUNK_EVENTS)

"""A video and a few stills, in constant memory, that appear on disk whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from torchtrack.core.atomic import atomic_path, writing
from torchtrack.errors import TorchtrackError
from torchtrack.viz.vp9 import Vp9File

# A pause of the events longer than this is shortened to it (seconds of video).
_LONGEST_PAUSE_S = 2.0
# Of the video, per second of events, where it plays so slowly that this is less than what a second of video may have at most.
_BITS_PER_EVENT_SECOND, _MOST_BITS_PER_SECOND = 24e6, 12e6


class OverlayWriter:
    """Writes pictures as a video (VP9 in MP4, which browsers play) that keeps the events' time, and some of them as PNG stills beside it.

    Used as a context, it leaves nothing behind when the block ends with an error; without any picture it writes nothing::

        with OverlayWriter("overlay.mp4") as writer:
            if writer.is_due(t_us):
                writer.add(t_us, draw_overlay(...))

    Args:
        path: the video, such as ``overlay.mp4``; a still at 0.5 s is named ``overlay_0.500s.png``.
        frames_per_second: of the video.
        slow_motion: how many times slower than life it plays.
        stills: how many, spread evenly over the video.
    """

    def __init__(self, path: str | os.PathLike[str], *, frames_per_second: float = 30.0, slow_motion: float = 4.0, stills: int = 4) -> None:
        self.path = Path(path)
        self._frames_per_second = frames_per_second
        self._bits_per_second = min(_BITS_PER_EVENT_SECOND / slow_motion, _MOST_BITS_PER_SECOND)
        self._period_us = 1e6 / (frames_per_second * slow_motion)
        self._frames = 0
        self._start_us = 0.0
        self._stills = _EvenStills(stills)
        self._files = ExitStack()
        self._video: Vp9File | None = None
        self._size = (0, 0)

    def __enter__(self) -> "OverlayWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.close()
            return
        if self._video is not None:
            self._video.abandon()
            self._video = None
        self._files.__exit__(kind, error, trace)

    def is_due(self, t_us: int) -> bool:
        """Whether the video needs a picture of this time; drawing others would be in vain."""
        return self._frames == 0 or t_us >= self._start_us + self._frames * self._period_us

    def add(self, t_us: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Show ``image`` (BGR) from the last picture's end up to ``t_us``; one that is not due is passed over.

        Raises:
            TorchtrackError: if the image is not of the size of the first, or the video's name does not end in ``.mp4``.
            OutputError: if the video cannot be written.
        """
        if not self.is_due(t_us):
            return
        if self._video is None:
            self._video, self._start_us, self._size = self._open(image), float(t_us), image.shape[:2]
        if image.shape[:2] != self._size:
            raise TorchtrackError(f"every picture of '{self.path}' must have the size of the first, {self._size}, got {image.shape[:2]}.")
        frames = int((t_us - self._start_us) / self._period_us) + 1 - self._frames
        longest = int(_LONGEST_PAUSE_S * self._frames_per_second) + 1
        if frames > longest:
            self._start_us += (frames - longest) * self._period_us
            frames = longest
        for _ in range(frames):
            self._video.write(_even(image))
        self._frames += frames
        self._stills.offer(t_us, image)

    def close(self) -> None:
        """Finish the video and write the stills."""
        try:
            if self._video is not None:
                video, self._video = self._video, None
                video.close()
            for t_us, picture in self._stills.chosen():
                still = self.path.with_name(f"{self.path.stem}_{t_us * 1e-6:.3f}s.png")
                with writing(still):
                    still.write_bytes(picture)
        finally:
            self._stills = _EvenStills(0)
            self._files.close()

    def _open(self, image: np.ndarray) -> Vp9File:
        if self.path.suffix.lower() != ".mp4":
            raise TorchtrackError(f"cannot write the video '{self.path}': its name must end in .mp4.")
        height, width = _even(image).shape[:2]
        temporary = self._files.enter_context(_unfinished(self.path))
        return Vp9File(temporary, self.path, (width, height), self._frames_per_second, self._bits_per_second)


@contextmanager
def _unfinished(path: Path) -> Iterator[Path]:
    """A path beside a video's to write it to; what was written replaces ``path`` when the block ends without an error.

    It is always the same: what a process that was killed has left is written over, or taken away, by the next one.
    """
    unfinished = path.with_name(f"{path.stem}.part{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield unfinished
        if unfinished.exists():
            with writing(path):
                unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def save_still(path: str | os.PathLike[str], image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture (BGR) as PNG."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(_png(image))


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _even(image: np.ndarray) -> np.ndarray:
    """The image with even height and width, whose halves are the size of its colours."""
    height, width = image.shape[:2]
    return cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT)


class _EvenStills:
    """Keeps pictures spread evenly over a stream of unknown length: every second one is dropped whenever there are too many."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._stride = 1
        self._seen = 0
        self._kept: list[tuple[int, bytes]] = []

    def offer(self, t_us: int, image: np.ndarray) -> None:
        if self._count and self._seen % self._stride == 0:
            self._kept.append((t_us, _png(image)))
            if len(self._kept) > 4 * self._count:
                self._kept = self._kept[::2]
                self._stride *= 2
        self._seen += 1

    def chosen(self) -> list[tuple[int, bytes]]:
        """The middle picture of each of ``count`` equal parts."""
        count = min(self._count, len(self._kept))
        return [self._kept[int((number + 0.5) / count * len(self._kept))] for number in range(count)]

"""One file of VP9 video in MP4, by PyAV: browsers and players of today show it without a plug-in."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from torchtrack.errors import OutputError

# Of what libvpx offers, the fastest; a quality at which lines of one pixel stay sharp, from 0 (best) to 63; and a first picture that is not
# many times as large as the others, which keeps short videos of many events within their size, too.
_SPEED = {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "tile-columns": "1"}
_OPTIONS = {**_SPEED, "crf": "36", "undershoot-pct": "50", "overshoot-pct": "20", "max-intra-rate": "300"}
_MOST_THREADS = 4


class Vp9File:
    """A video file that pictures are appended to.

    Args:
        path: the file.
        name: what the file is called in errors.
        size: width and height (px), both even.
        frames_per_second: of the video.
        bits_per_second: about how large it may become.

    Raises:
        OutputError: if it cannot be written.
    """

    def __init__(self, path: Path, name: Path, size: tuple[int, int], frames_per_second: float, bits_per_second: float) -> None:
        self._name = name
        with self._writing():
            # What it plays at comes first in the file: a browser can start before it has all of it.
            self._container = av.open(os.fspath(path), "w", format="mp4", options={"movflags": "+faststart"})
            rate = Fraction(frames_per_second).limit_denominator(1000)
            self._stream = self._container.add_stream("libvpx-vp9", rate=rate, options=dict(_OPTIONS))
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.bit_rate = round(bits_per_second)
        self._stream.codec_context.thread_count = min(os.cpu_count() or 1, _MOST_THREADS)

    def write(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append a picture (BGR).

        Raises:
            OutputError: if it cannot be written.
        """
        with self._writing():
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))

    def close(self) -> None:
        """Complete the file.

        Raises:
            OutputError: if it cannot be written.
        """
        with self._writing():
            self._container.mux(self._stream.encode())
            self._container.close()

    def abandon(self) -> None:
        """Let go of the file, whatever is in it."""
        with suppress(av.FFmpegError):
            self._container.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except av.FFmpegError as error:
            raise OutputError(f"cannot write to '{self._name}': {error.strerror or error}. Is the disk full?") from error

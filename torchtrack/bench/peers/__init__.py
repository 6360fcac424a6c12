"""How fast other libraries do the same, in the same run and on the same inputs; those that are not installed are named.

None of them is needed by torchtrack. Where results can be compared, they are; and where a library does something else, the notes
say so.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from torchtrack.bench.peers import filters, poses, surfaces, trackers
from torchtrack.bench.peers.comparison import Comparison
from torchtrack.bench.results import Report
from torchtrack.bench.setup import Setup


def measure(setup: Setup) -> Report:
    """Times of ours and of others."""
    comparison = Comparison(setup)
    with _opencv_threads(setup.threads):
        for part in (poses, filters, surfaces, trackers):
            part.compare(comparison)
    title = f"Other libraries on the same inputs; {setup.clock.meaning}"
    return Report("peers", title, tuple(comparison.results), tuple(comparison.notes), tuple(comparison.plots))


@contextmanager
def _opencv_threads(count: int) -> Iterator[None]:
    """OpenCV has threads of its own, which nobody would time."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)

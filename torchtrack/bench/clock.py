"""The clock that a benchmark goes by, and how work is timed with it."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

# A figure is of as many runs as fill this (s): one run of short work says little.
_LEAST_S = 0.02


@dataclass(frozen=True)
class Clock:
    """Time that work takes on a device.

    On one thread of the CPU it is that thread's own time: on an idle machine that is the time that passes, and other work
    beside it does not count. On several threads, and on a GPU, it is the time that passes until all is done.

    Args:
        device: where the work runs.
        threads: of the work on the CPU.
    """

    device: torch.device
    threads: int = 1

    @property
    def meaning(self) -> str:
        """What it counts, in words."""
        return "time of the one thread" if self._of_thread else "time that passes"

    @property
    def _of_thread(self) -> bool:
        return self.device.type == "cpu" and self.threads == 1

    def now(self) -> float:
        """Seconds, once all that was asked of the device is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.thread_time() if self._of_thread else time.perf_counter()

    def seconds(self, work: Callable[[], object], repeats: int) -> list[float]:
        """Time of one run (s) of ``work``, ``repeats`` times after a warm-up."""
        work()
        runs = max(1, int(_LEAST_S / max(self._time(work, 1), 1e-9)))
        return [self._time(work, runs) for _ in range(repeats)]

    def _time(self, work: Callable[[], object], runs: int) -> float:
        begun = self.now()
        for _ in range(runs):
            work()
        return (self.now() - begun) / runs

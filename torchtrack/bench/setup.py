"""How a benchmark is to be run."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from torchtrack.bench.clock import Clock


def _tell_nobody(name: str) -> None:
    """Where nobody wants to know what is being measured."""


@dataclass(frozen=True)
class Setup:
    """How a benchmark is to be run.

    Args:
        repeats: how often everything is measured.
        device: where tensors are.
        threads: of PyTorch on the CPU.
        events: of the files of the part ``io``.
        sequence: a sequence to track in place of simulated scenes.
        compiled: whether one object, and on a GPU many, are also tracked by compiled graphs, which takes minutes to prepare.
        show: called with the name of what is measured next.
    """

    repeats: int = 7
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    threads: int = 1
    events: int = 5_000_000
    sequence: Path | None = None
    compiled: bool = False
    show: Callable[[str], None] = _tell_nobody

    @cached_property
    def clock(self) -> Clock:
        """The clock that fits the device."""
        return Clock(self.device, self.threads)

    @property
    def ways(self) -> tuple[bool, ...]:
        """Whether objects are tracked by compiled graphs: not, and where that is asked for also so."""
        return (False, True) if self.compiled else (False,)

    def cpu_target(self, target: float | None) -> float | None:
        """A target that holds on a CPU alone; None elsewhere."""
        return target if self.device.type == "cpu" else None

"""Values that are read back from a GPU, which make the CPU wait for it, and how the tracker goes without.

On the CPU a value is there once it is computed: sizes are exact, and a decision is taken where it comes up. A GPU works off
a queue, and to read a value from it is to wait until the queue is empty, with nothing new in it. There, sizes are bounds
that the settings and the image give, and what must be decided is asked for early (:class:`Answer`): its copy is begun in
the middle of a window's work, and looked at once much more has been queued behind it. One is not: whether to search hangs
on what the window's own alignment explains, and there the queue runs dry once.

So the CPU is never a whole window ahead, and every decision is the one that the CPU takes. The flag of the window before
would be there already, but objects would be searched for a window late. To ``torch.cuda.set_sync_debug_mode`` an answer is
no synchronisation: it reports what waits for all that is queued.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


def read_at_once(values: Tensor) -> bool:
    """Whether values can be read, and shapes hang on them, at no cost: on the CPU."""
    return values.is_cpu and not torch.compiler.is_compiling()


def on_gpu(values: Tensor) -> bool:
    """Whether values are on a GPU, where another way to the same result may be the faster one."""
    return values.is_cuda


def none_of(values: Tensor) -> bool:
    """Whether it is certain, at no cost, that no value is true: what only true ones need can then be left out."""
    if not read_at_once(values):
        return False
    # Of the few of a row, a list is made in a fraction of the time.
    return not any(values.tolist()) if values.dim() == 1 else not bool(values.any())


@dataclass(frozen=True)
class Answer:
    """Values that the CPU has, or that are on their way to it, where decisions are taken.

    Args:
        on_device: the values.
        copy: the same on the CPU, once ``arrived``; as numbers, where they were known from the start.
        arrived: when the copy is there; none where nothing had to be copied.
    """

    on_device: Tensor
    copy: Tensor | list[Any]
    arrived: torch.cuda.Event | None = None

    @classmethod
    def to(cls, values: Tensor) -> "Answer":
        """Begin to copy values; from the CPU they need not be."""
        values = values.detach()
        if values.device.type != "cuda":
            return cls(values, values)
        copy = values.to("cpu", non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record(torch.cuda.current_stream(values.device))
        return cls(values, copy, arrived)

    @classmethod
    def of(cls, number: int, like: Tensor) -> "Answer":
        """One number for each of some values, known without a look at them."""
        return cls(torch.full_like(like, number), [number] * like.numel())

    def any(self) -> bool:
        """Whether any of the values is true."""
        return any(self.numbers())

    def numbers(self) -> list[Any]:
        """The values, once they have arrived."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return self.copy.tolist() if torch.is_tensor(self.copy) else self.copy


class Questions:
    """How a step asks for what it has to decide."""

    def ask(self, values: Tensor, usual: int) -> Answer:
        """Begin to ask for values, which in a steady window are all ``usual``."""
        return Answer.to(values)

    def none_of(self, values: Tensor) -> bool:
        """Whether it is certain that no value is true, as in a steady window; on a GPU it never is, as it would take a wait."""
        return none_of(values)


class Assumptions(Questions):
    """All is taken to be as usual, where nothing can be asked for: within a CUDA graph."""

    def __init__(self) -> None:
        self._wrong: list[Tensor] = []

    def ask(self, values: Tensor, usual: int) -> Answer:
        """The usual answer; whether it is the right one is noted."""
        self._wrong.append((values.detach() != usual).any())
        return Answer.of(usual, values)

    def none_of(self, values: Tensor) -> bool:
        """As usual: none."""
        self._wrong.append(values.detach().any())
        return True

    def wrong(self) -> Tensor:
        """Whether any answer so far was not the right one."""
        return torch.stack(self._wrong).any()

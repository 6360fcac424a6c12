"""Values that the CPU reads back from a GPU, and how the tracker avoids to wait for them.

On the CPU a value is there once it is computed: sizes are exact, and a decision is taken where it comes up. A GPU works off
a queue. To read a value, the CPU waits until the queue is empty, and queues nothing meanwhile. So on a GPU, sizes are bounds
that the settings and the image give, and a value that a decision needs is requested early (:class:`AsyncValue`): its copy
begins in the middle of a window's work, and the CPU looks at it after it has queued much more. One value comes late: whether
to search depends on what the window's own alignment explains. There the queue runs empty once a window.

So the CPU is never a whole window ahead, and every decision is the one that the CPU takes. The flag of the window before
would be there already, but objects would be searched for a window late. ``torch.cuda.set_sync_debug_mode`` does not report
an :class:`AsyncValue`: it reports what waits for all that is queued.
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
class AsyncValue:
    """Values that the CPU has, or that are on their way to it.

    Args:
        on_device: the values.
        copy: the same on the CPU, once ``arrived``; as numbers, where they were known from the start.
        arrived: when the copy is there; none where nothing had to be copied.
    """

    on_device: Tensor
    copy: Tensor | list[Any]
    arrived: torch.cuda.Event | None = None

    @classmethod
    def to(cls, values: Tensor) -> "AsyncValue":
        """Begin to copy values; from the CPU they need not be."""
        values = values.detach()
        if values.device.type != "cuda":
            return cls(values, values)
        copy = values.to("cpu", non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record(torch.cuda.current_stream(values.device))
        return cls(values, copy, arrived)

    @classmethod
    def known(cls, number: int, like: Tensor) -> "AsyncValue":
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


class HostReads:
    """How a step requests the values that its decisions need."""

    def ask(self, values: Tensor, usual: int) -> AsyncValue:
        """Begin to copy values, which in a steady window are all ``usual``."""
        return AsyncValue.to(values)

    def ask_within(self, values: Tensor, usual: int, most: int) -> AsyncValue:
        """:meth:`ask` for values that are at least ``usual`` and at most ``most``: a bound will do in their place."""
        return self.ask(values, usual)

    def none_of(self, values: Tensor) -> bool:
        """Whether it is certain that no value is true, as in a steady window. On a GPU it is never certain: the CPU would have to wait."""
        return none_of(values)


class SteadyState(HostReads):
    """Takes every value to be the usual one. A CUDA graph needs this: within it, nothing can be read."""

    def __init__(self) -> None:
        self._wrong: list[Tensor] = []

    def ask(self, values: Tensor, usual: int) -> AsyncValue:
        """The usual value; whether it is the true one is noted."""
        self._wrong.append((values.detach() != usual).any())
        return AsyncValue.known(usual, values)

    def none_of(self, values: Tensor) -> bool:
        """As usual: none."""
        self._wrong.append(values.detach().any())
        return True

    def wrong(self) -> Tensor:
        """Whether any value so far was not the usual one."""
        return torch.stack(self._wrong).any()


class UncertainState(SteadyState):
    """Takes no object to be certain: what uncertain ones need is computed for all."""

    def ask_within(self, values: Tensor, usual: int, most: int) -> AsyncValue:
        """The values themselves on the device, and the bound for what hangs on the largest of them."""
        return AsyncValue(values.detach(), [most] * values.numel())

    def none_of(self, values: Tensor) -> bool:
        """Not certain."""
        return False

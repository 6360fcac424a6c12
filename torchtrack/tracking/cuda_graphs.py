"""CUDA graphs: all kernels of a function, recorded once and from then on started together.

A window of one object is some two thousand kernels of two microseconds each, and to ask for one takes Python several times
that. A graph reads and writes the same memory every time it is started: what it is given is copied there, and what it gives
is copied from there. Both are many small tensors, which few kernels copy.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any

import torch
from torch import Tensor

from torchtrack.core.field_values import field_values
from torchtrack.tracking.state import each_tensor

_Function = Callable[..., tuple[Any, ...]]


@dataclass
class _Recorded:
    """A graph, and the memory that it works on.

    Args:
        replay: starts its kernels.
        reads: what they read.
        given: whose values ``reads`` holds.
        results: the function's.
        passed_on: the number in ``reads`` of each tensor of the results that is there already; None for the others.
    """

    replay: Callable[[], None]
    reads: list[Tensor]
    given: list[Tensor]
    results: tuple[Any, ...]
    passed_on: list[int | None]


class CudaGraphs:
    """A function of dataclasses and tensors on a GPU as CUDA graphs, one for each size of what it is given.

    Args:
        function: of values that are never changed in place; what it does is to hang on nothing but their sizes.

    Calls are to come from one thread at a time, and on one stream of the GPU.
    """

    def __init__(self, function: _Function) -> None:
        self._function = function
        self._of_sizes: dict[tuple[torch.Size, ...], _Recorded] = {}
        self._memory: Any = None

    def __call__(self, *values: Any) -> tuple[Any, ...]:
        """The function's results, in memory of their own; tensors that it passes on are those that it was given."""
        given = list(_tensors(*values))
        sizes = tuple(tensor.shape for tensor in given)
        recorded = self._of_sizes.get(sizes)
        if recorded is None:
            recorded = self._of_sizes[sizes] = self._record(values)
        # What was passed on in one window comes back in the next, and is there already.
        changed = [number for number, (new, old) in enumerate(zip(given, recorded.given, strict=True)) if new is not old]
        _copy([recorded.reads[number] for number in changed], [given[number] for number in changed])
        recorded.given = given
        recorded.replay()
        return _copied(recorded)

    def __len__(self) -> int:
        """How many graphs there are."""
        return len(self._of_sizes)

    def _record(self, values: tuple[Any, ...]) -> _Recorded:
        """The function recorded, after a call that loads its kernels and compiles what is to be."""
        held = tuple(each_tensor(_held, value) for value in values)
        reads = list(_tensors(*held))
        with torch.cuda.device(reads[0].device):
            aside = torch.cuda.Stream()
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                self._function(*held)
            torch.cuda.current_stream().wait_stream(aside)
            graph = torch.cuda.CUDAGraph()
            # The graphs share what memory comes between: no two of them are under way at a time. Other threads may use the GPU meanwhile.
            with torch.cuda.graph(graph, pool=self._memory, capture_error_mode="thread_local"):
                results = self._function(*held)
        self._memory = graph.pool()
        numbers = {id(tensor): number for number, tensor in enumerate(reads)}
        return _Recorded(graph.replay, reads, reads, results, [numbers.get(id(tensor)) for tensor in _tensors(*results)])


def _held(tensor: Tensor) -> Tensor:
    """A copy at a place of its own, also of what lies at one place many times."""
    return tensor.clone(memory_format=torch.contiguous_format)


def _tensors(*values: Any) -> Iterator[Tensor]:
    """All tensors of dataclasses, of those within them, or themselves, in the order of :func:`~torchtrack.tracking.state.each_tensor`."""
    for value in values:
        if torch.is_tensor(value):
            yield value
        elif is_dataclass(value):
            yield from _tensors(*field_values(value).values())


def _copied(recorded: _Recorded) -> tuple[Any, ...]:
    """The results of a graph as they are now."""
    written, copies = [], []
    passed_on = iter(recorded.passed_on)

    def own(tensor: Tensor) -> Tensor:
        number = next(passed_on)
        if number is not None:
            return recorded.given[number]
        written.append(tensor)
        copies.append(torch.empty_like(tensor))
        return copies[-1]

    results = tuple(each_tensor(own, value) for value in recorded.results)
    _copy(copies, written)
    return results


def _copy(to: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    """Copy many tensors: those of one type that lie alike in memory by one kernel."""
    alike: dict[tuple[torch.dtype, bool], tuple[list[Tensor], list[Tensor]]] = {}
    for place, value in zip(to, values, strict=True):
        places, others = alike.setdefault((value.dtype, place.stride() == value.stride()), ([], []))
        places.append(place)
        others.append(value)
    for places, others in alike.values():
        torch._foreach_copy_(places, others)

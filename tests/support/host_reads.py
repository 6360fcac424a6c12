"""Where a computation would make the CPU wait for a GPU, found on the CPU alone.

Values that are read back, shapes that depend on values, and tensors that are made of Python numbers: on a GPU each of them waits
until all that was asked of it before is done. So does a number that is written to places of a tensor: it comes from the CPU's memory.
"""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch.utils._python_dispatch import TorchDispatchMode

# In inference mode some operations arrive here whole, and else as what they are made of.
_READS = ("item", "_local_scalar_dense", "is_nonzero", "equal", "nonzero", "masked_select", "bincount", "_unique2", "unique_dim")
# These ask whether they succeeded.
_CHECKED = ("_linalg_check_errors", "linalg_cholesky", "linalg_solve", "linalg_inv")


class _Watch(TorchDispatchMode):
    """Notes the line of the package that asked for each operation that waits."""

    def __init__(self, places: list[str]) -> None:
        super().__init__()
        self.places = places
        # Tensors that Python numbers were made: kept, so that no other takes their place in memory.
        self._numbers: list[torch.Tensor] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.removeprefix("aten::")
        made_here = name == "lift_fresh" and args[0].dim() > 0
        counted = name == "repeat_interleave" and func._overloadname in ("Tensor", "self_Tensor")
        number_written = name.startswith("index_put") and any(args[2] is number for number in self._numbers)
        if name in _READS + _CHECKED or made_here or counted or number_written or (name.startswith("index") and _by_mask(args)):
            _note(self.places, name)
        made = func(*args, **(kwargs or {}))
        if name == "lift_fresh":
            self._numbers.append(made)
        return made


def _by_mask(args) -> bool:
    indices = args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else []
    return any(torch.is_tensor(index) and index.dtype == torch.bool for index in indices)


def _note(places: list[str], name: str) -> None:
    """Note an operation, unless it looks at what was asked for early."""
    place = _place(name)
    if not place.startswith("core/host_sync.py"):
        places.append(place)


def _place(name: str) -> str:
    """The operation, and the innermost line of the package."""
    for frame in reversed(traceback.extract_stack()):
        _, within, path = frame.filename.rpartition("/torchtrack/")
        if within:
            return f"{path}:{frame.lineno} {name}: {frame.line}"
    return f"outside: {name}"


@contextmanager
def host_reads() -> Iterator[list[str]]:
    """The places that would wait, while it is open."""
    places: list[str] = []
    to_list = torch.Tensor.tolist

    def noted(tensor: torch.Tensor):
        _note(places, "tolist")
        return to_list(tensor)

    torch.Tensor.tolist = noted
    try:
        with _Watch(places):
            yield places
    finally:
        torch.Tensor.tolist = to_list

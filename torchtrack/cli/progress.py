"""What a terminal shows of a command that takes its time: bars on standard error, one of them for kernels that are compiled."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from torchtrack.core.dispatch import backend_is_installed
from torchtrack.io.extras import optional

_COMPILING = "numba:compile"
_KERNELS = "compiling kernels (about 40 s, once)"


class _Rates(ProgressColumn):
    """What a task says of its speed, where it says anything."""

    def render(self, task: Task) -> Text:
        return Text(str(task.fields.get("rates", "")))


@contextmanager
def progress_shown(*, quiet: bool = False, kernels: bool = True) -> Iterator[Progress]:
    """Bars for tasks, with their share in % and the time left: on standard error, where that is a terminal, until the end of the block.

    Args:
        quiet: nothing is shown.
        kernels: whether kernels may be compiled meanwhile, which is a task of its own then.
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        _Rates(),
    )
    shown = not quiet and console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not shown) as progress:
        if not (shown and kernels and backend_is_installed()):
            yield progress
            return
        with _compilation_shown(progress):
            yield progress


def share_of(progress: Progress, name: str) -> Callable[[float], None]:
    """A new task, and what is called with the share of it that is done; before the first call, that is unknown."""
    task = progress.add_task(name, total=None)
    return lambda share: progress.update(task, total=1.0, completed=share)


@contextmanager
def _compilation_shown(progress: Progress) -> Iterator[None]:
    """A task while kernels are compiled. Those that are read from the disk, as in all later runs, make none."""
    event = optional("numba.core.event", "numba", "fast", "kernels")
    task = progress.add_task(_KERNELS, total=None, start=False, visible=False)
    depth = compiled = total = 0

    class Listener(event.Listener):
        """Counts kernels; each compiles those that it calls within its own compilation."""

        def on_start(self, event: Any) -> None:
            nonlocal depth, total
            if total == 0:
                total = _kernels_left()
                progress.start_task(task)
            depth += 1
            progress.update(task, total=max(total, compiled + 1), visible=True, refresh=compiled == 0)

        def on_end(self, event: Any) -> None:
            nonlocal depth, compiled
            depth -= 1
            compiled += _is_ours(event.data["dispatcher"])
            progress.update(task, completed=compiled, visible=depth > 0)

    listener = Listener()
    event.register(_COMPILING, listener)
    try:
        yield
    finally:
        event.unregister(_COMPILING, listener)


def _is_ours(dispatcher: Any) -> bool:
    """Whether it is a kernel of this package, and not one of Numba's own functions."""
    return str(dispatcher.__module__).startswith("torchtrack.")


def _kernels_left() -> int:
    """How many kernels of the modules that are loaded have not been compiled, nor read from the disk."""
    loaded = [module for name, module in tuple(sys.modules.items()) if name.startswith("torchtrack.")]
    values = [(module, value) for module in loaded for value in vars(module).values()]
    return sum(hasattr(value, "py_func") and value.__module__ == module.__name__ and not value.signatures for module, value in values)

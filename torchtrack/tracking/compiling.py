"""Windows as graphs that ``torch.compile`` makes: each compiled for one tracker, and for any number of events.

What is compiled hangs on nothing that may change, so nothing is looked at before it is called. PyTorch has to be told which functions it is not
to look into.
"""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchtrack.core import dispatch
from torchtrack.core.constants import cells_within
from torchtrack.errors import ConfigError, TorchtrackWarning
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.state import TrackerState, each_tensor

P, R = ParamSpec("P"), TypeVar("R")
# A window of a GPU: its state and result, and more.
Lane = Callable[[TrackerState, NearbyEvents, Tensor], tuple[Any, ...]]


def check_version() -> None:
    """Look whether PyTorch can compile a tracker.

    Raises:
        ConfigError: if this version cannot.
    """
    if not hasattr(torch.compiler, "skip_all_guards_unsafe"):
        raise ConfigError(f"compiled: PyTorch {torch.__version__} cannot compile a tracker. Update it to 2.11 or later, or go without.")


def compiled(function: Callable[P, R], device: torch.device) -> Callable[P, R]:
    """A function as a graph of its own, which is compiled when it is first called."""
    # All that it hangs on is fixed with the tracker: to look whether it is takes a tenth of a step.
    options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe, "cpp_wrapper": device.type == "cpu"}
    # Not where it is defined: that would import the compiler, which takes as long as PyTorch itself, wherever a tracker is.
    for constant in (cells_within, dispatch.backend_in_graphs):
        torch.compiler.assume_constant_result(constant)
    graph: Callable[P, R] = torch.compile(_with_code_of_its_own(function), fullgraph=True, dynamic=False, options=options)
    return graph


def _with_code_of_its_own(function: Callable[P, R]) -> Callable[P, R]:
    """The function once more. What is compiled of it is kept with its code; without guards, no two functions may share that."""

    def own(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    own.__code__ = own.__code__.replace()
    return own


def for_the_first_time(graph: Callable[Concatenate[TrackerState, P], R], state: TrackerState, *args: P.args, **kwargs: P.kwargs) -> R:
    """What a graph gives that is compiled for this.

    Raises:
        ConfigError: if it cannot be.
    """
    # A tensor that stands for two of the state's would be taken for both of them ever after.
    return _explained(graph)(each_tensor(Tensor.clone, state), *args, **kwargs)


def compiled_or_as_it_is(lane: Lane, device: torch.device) -> Lane:
    """The graph of a GPU, compiled; where PyTorch fails to, as some versions do for some objects, it warns and leaves the graph as it is."""
    graph, can_be = _explained(compiled(lane, device)), True

    def either(before: TrackerState, filled: NearbyEvents, t_us: Tensor) -> tuple[Any, ...]:
        nonlocal can_be
        if can_be:
            try:
                return graph(before, of_any_number(filled), t_us)
            except ConfigError as error:
                can_be = False
                warnings.warn(f"{error} Windows are taken by graphs that are not compiled.", TorchtrackWarning, stacklevel=2)
        return lane(before, filled, t_us)

    return either


def _explained(graph: Callable[P, R]) -> Callable[P, R]:
    """The graph; where it cannot be compiled, :class:`~torchtrack.errors.ConfigError` says why."""

    def explained(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with _as_expected():
                return graph(*args, **kwargs)
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            needed = "a C++ compiler (g++ or clang++), or on a GPU triton and a C compiler"
            raise ConfigError(f"compiled: the tracker could not be compiled: {reason}. It needs {needed}. Install that, or go without.") from error

    return explained


@contextmanager
def _as_expected() -> Iterator[None]:
    """Within it, the compiler does not report which operations it leaves to PyTorch, nor what it will do otherwise one day."""
    logger = logging.getLogger("torch._inductor")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(before)


def of_any_number(filled: NearbyEvents) -> NearbyEvents:
    """The events, marked for the compiler: there may be another number of them another time."""
    events = filled.events
    for values in (events.x, events.y, events.t_us, events.polarity, events.stream_index, filled.number):
        if values is not None:
            torch._dynamo.mark_dynamic(values, 0)
    return filled

"""Tasks of several items each: those that can be handled as one batch."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TypeVar

from torchtrack.config.executor import ExecutorName
from torchtrack.run.executor import TaskFailure, Tell, run_tasks

T = TypeVar("T")
R = TypeVar("R")


def run_in_groups(
    function: Callable[[Sequence[T], Tell], Sequence[R | TaskFailure]],
    items: Sequence[T],
    alike: Sequence[Hashable],
    size: int,
    executor: ExecutorName,
    jobs: int,
) -> Iterator[tuple[Sequence[int], Sequence[R | TaskFailure]]]:
    """Tasks of several items each; gives the numbers of the items of each and what became of them, as it comes.

    See :func:`torchtrack.run.executor.run_tasks`.

    Args:
        function: called with the items of a group; gives an outcome for each.
        alike: items are handled together where this is the same.
        size: of a group, at most.
    """
    groups = grouped(alike, size)
    for place, outcome in run_tasks(function, [[items[number] for number in group] for group in groups], executor, jobs):
        yield groups[place], [outcome] * len(groups[place]) if isinstance(outcome, TaskFailure) else outcome


def grouped(alike: Sequence[Hashable], size: int) -> list[list[int]]:
    """Numbers of items that are alike, ``size`` at most together, in the order of the first of each group."""
    numbers_by_key: dict[Hashable, list[int]] = {}
    for number, key in enumerate(alike):
        numbers_by_key.setdefault(key, []).append(number)
    return sorted(numbers[first : first + size] for numbers in numbers_by_key.values() for first in range(0, len(numbers), size))

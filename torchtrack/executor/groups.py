"""Tasks of several items each: those that can be handled as one batch."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TypeVar

from torchtrack.config.executor import ExecutorName
from torchtrack.executor import TaskFailure, Tell, run_tasks

T = TypeVar("T")
R = TypeVar("R")


def run_in_groups(
    function: Callable[[Sequence[T], Tell], Sequence[R | TaskFailure]],
    items: Sequence[T],
    alike: Sequence[Hashable],
    size: int,
    executor: ExecutorName,
    jobs: int,
) -> Iterator[tuple[int, R | TaskFailure]]:
    """Tasks of several items each; gives the number of each item and what became of it, as it comes.

    See :func:`torchtrack.executor.run_tasks`.

    Args:
        function: called with the items of a group; gives an outcome for each.
        alike: items are handled together where this is the same.
        size: of a group, at most.
    """
    groups = grouped(alike, size)
    outcomes = run_tasks(function, [[items[number] for number in group] for group in groups], executor, jobs)
    return _of_items(groups, outcomes)


def _of_items(
    groups: Sequence[Sequence[int]], outcomes: Iterator[tuple[int, Sequence[R | TaskFailure] | TaskFailure]]
) -> Iterator[tuple[int, R | TaskFailure]]:
    """What became of each item, given what became of the groups."""
    for place, outcome in outcomes:
        of_each = [outcome] * len(groups[place]) if isinstance(outcome, TaskFailure) else outcome
        yield from zip(groups[place], of_each, strict=True)


def grouped(alike: Sequence[Hashable], size: int) -> list[list[int]]:
    """Numbers of items that are alike, ``size`` at most together, in the order of the first of each group."""
    found: dict[Hashable, list[int]] = {}
    for number, key in enumerate(alike):
        found.setdefault(key, []).append(number)
    return sorted(numbers[first : first + size] for numbers in found.values() for first in range(0, len(numbers), size))

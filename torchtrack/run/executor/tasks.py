"""What a task is, and how one that fails is told."""

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from torchtrack.errors import TorchtrackError

T = TypeVar("T")
R = TypeVar("R")

Tell = Callable[[float], None]
"""Called with how far a task is, from 0 to 1."""

# A task whose process was killed is tried so often in all.
ATTEMPTS = 3


@dataclass(frozen=True)
class TaskFailure:
    """Why a task gave no result."""

    reason: str


def attempt(function: Callable[[T, Tell], R], task: T, tell: Tell) -> R | TaskFailure:
    """The result of a task, or why it has none."""
    try:
        return function(task, tell)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is told, and the other tasks go on
        return TaskFailure(reason_of(error))


def reason_of(error: Exception) -> str:
    """What went wrong; an error that is neither ours nor the system's is a bug, and is told with the place where it happened."""
    return str(error) if isinstance(error, TorchtrackError | OSError) else "".join(traceback.format_exception(error))


def killed(how: str) -> TaskFailure:
    """A task that no process survived."""
    return TaskFailure(f"the process that worked on it ended {ATTEMPTS} times, the last time {how}. Is there memory enough? Try fewer jobs.")


def without_errors(outcomes: Sequence[R | TorchtrackError | OSError]) -> list[R | TaskFailure]:
    """Errors as what can be sent from one process to another."""
    return [TaskFailure(reason_of(outcome)) if isinstance(outcome, TorchtrackError | OSError) else outcome for outcome in outcomes]

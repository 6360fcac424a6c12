"""Independent tasks in several processes: on this machine, or with Ray on many.

::

    for number, outcome in run_tasks(function, tasks, "local", jobs=4):
        if isinstance(outcome, TaskFailure): ...

One task that fails does not stop the others. One whose process was killed, for example because memory ran out, is tried
again, up to :data:`ATTEMPTS` times in all. Whatever ends the loop early, such as Ctrl-C, ends the processes too.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from torchtrack.config.executor import ExecutorName
from torchtrack.errors import ConfigError
from torchtrack.run.executor.local import run_here, run_in_processes
from torchtrack.run.executor.tasks import ATTEMPTS, TaskFailure, Tell

__all__ = ["ATTEMPTS", "TaskFailure", "Tell", "run_tasks"]

T = TypeVar("T")
R = TypeVar("R")


def run_tasks(
    function: Callable[[T, Tell], R],
    tasks: Sequence[T],
    executor: ExecutorName = "local",
    jobs: int = 1,
    on_progress: Callable[[int, float], None] = lambda number, share: None,
) -> Iterator[tuple[int, R | TaskFailure]]:
    """The number of each task and what became of it, as it comes.

    Function, tasks and results are pickled. With Ray every machine needs torchtrack, and the files that tasks name at the
    same paths, for example on a shared disk.

    Args:
        function: called with a task, and with what tells how far it is, from 0 to 1.
        tasks: what is to be done.
        executor: ``local`` for processes of this machine, or for this process itself where there is nothing to share
            out; ``ray`` for the cluster at ``$RAY_ADDRESS``, or for one that is started on this machine.
        jobs: how many processes; the cluster at ``$RAY_ADDRESS`` has its own number.
        on_progress: called with the number of a task and how far it is.

    Raises:
        MissingExtraError: if Ray is wanted and not installed.
        ConfigError: if ``jobs`` is less than one, or the cluster cannot be reached.
    """
    if jobs < 1:
        raise ConfigError(f"jobs: at least one process is needed, got {jobs}.")
    processes = min(jobs, len(tasks))
    if executor == "ray" and tasks:
        # Each process imports this file anew: what it does not need would only make it slower to start.
        from torchtrack.run.executor.on_ray import run_on_ray

        return run_on_ray(function, tasks, jobs, on_progress)
    return run_in_processes(function, tasks, processes, on_progress) if processes > 1 else run_here(function, tasks, on_progress)

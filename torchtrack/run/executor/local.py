"""Tasks in this process, or in processes of this machine.

The pool of the standard library breaks as a whole when one of its processes is killed, and does not say which task that
one had. Here each process has a pipe of its own: when it ends, its task is known, and another process takes its place.
"""

import contextlib
import multiprocessing
import pickle
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn, TypeVar

from torchtrack.run.executor.tasks import ATTEMPTS, TaskFailure, Tell, attempt, killed

T = TypeVar("T")
R = TypeVar("R")

# A process that is told to end has this long to clean up (s).
_GRACE_S = 10.0
# Started afresh, not forked: a fork of a process with threads of its own can hang.
_CONTEXT = multiprocessing.get_context("spawn")


def run_here(
    function: Callable[[T, Tell], R], tasks: Sequence[T], on_progress: Callable[[int, float], None]
) -> Iterator[tuple[int, R | TaskFailure]]:
    """One task after the other in this process."""
    for number, task in enumerate(tasks):
        yield number, attempt(function, task, lambda share, number=number: on_progress(number, share))  # type: ignore[misc]


def run_in_processes(
    function: Callable[[T, Tell], R], tasks: Sequence[T], processes: int, on_progress: Callable[[int, float], None]
) -> Iterator[tuple[int, R | TaskFailure]]:
    """All tasks in so many processes."""
    waiting, ended = deque(range(len(tasks))), Counter[int]()
    workers = [_Worker(function) for _ in range(processes)]
    try:
        while True:
            for worker in workers:
                if worker.idle and waiting:
                    worker.give(waiting[0], tasks[waiting.popleft()])
            at_work = {worker.pipe: worker for worker in workers if not worker.idle}
            if not at_work:
                return
            for pipe in wait(list(at_work)):
                worker = at_work[pipe]  # type: ignore[index]
                number, (kind, value) = worker.number, worker.receive()
                if kind == "share":
                    on_progress(number, value)
                elif kind == "outcome":
                    yield number, value
                else:
                    workers[workers.index(worker)] = _Worker(function)
                    ended[number] += 1
                    if ended[number] == ATTEMPTS:
                        yield number, killed(value)
                    else:
                        # Behind the others: what needs much memory may find it once they are done.
                        waiting.append(number)
    finally:
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.wait_for_end()


class _Worker:
    """One process, whether it is idle, and the number of the task that it has or had."""

    def __init__(self, function: Callable[[Any, Tell], Any]) -> None:
        self.idle, self.number = True, -1
        self.pipe, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(function, theirs), daemon=True)
        with _without_interrupts():
            self._process.start()
        # The process alone has its end now: when it is gone, the pipe is at its end.
        theirs.close()

    def give(self, number: int, task: object) -> None:
        """Have a task worked on."""
        self.idle, self.number = False, number
        # A process that is gone is noticed when its answer is read.
        with contextlib.suppress(OSError):
            self.pipe.send_bytes(pickle.dumps(task))

    def receive(self) -> tuple[str, Any]:
        """``share`` and how far the task is, ``outcome`` and what became of it, or ``ended`` and how, where the process did."""
        try:
            kind, value = pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            self.wait_for_end()
            code = self._process.exitcode or 0
            return "ended", f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        if kind == "outcome":
            self.idle = True
        return kind, value

    def dismiss(self) -> None:
        """Have the process end, in the midst of its task if it has one."""
        self._process.terminate()

    def wait_for_end(self) -> None:
        """Wait until the process has ended, by force if need be."""
        self._process.join(_GRACE_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        self.pipe.close()


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ctrl-C waits until the block ends; a process started within never gets it: its parent answers, and ends it."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(function: Callable[[Any, Tell], Any], pipe: Connection) -> None:
    """What a process does: one task after the other, until it is told to end, or its parent is gone."""
    signal.signal(signal.SIGTERM, _interrupt)

    def tell(share: float) -> None:
        pipe.send_bytes(pickle.dumps(("share", share)))

    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            outcome = attempt(function, pickle.loads(pipe.recv_bytes()), tell)
            pipe.send_bytes(pickle.dumps(("outcome", outcome)))


def _interrupt(number: int, frame: object) -> NoReturn:
    """Leave whatever is being done, in good order: what is half written is taken away on the way out."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt

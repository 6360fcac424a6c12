"""Tasks on a Ray cluster: that of ``$RAY_ADDRESS``, or one on this machine that is started for them and ended after them."""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from torchtrack.errors import ConfigError
from torchtrack.io.extras import optional
from torchtrack.run.executor.tasks import ATTEMPTS, TaskFailure, Tell, attempt, killed, reason_of

T = TypeVar("T")
R = TypeVar("R")

# A cluster that is there answers within this (s).
_CONNECT_S = 5.0
# How often progress is asked for (s).
_POLL_S = 0.2
# Tasks that are told to end have this long to clean up (s).
_GRACE_S = 10.0


def run_on_ray(
    function: Callable[[T, Tell], R], tasks: Sequence[T], jobs: int, on_progress: Callable[[int, float], None]
) -> Iterator[tuple[int, R | TaskFailure]]:
    """All tasks on the cluster, or in so many processes of one that is started on this machine."""
    ray = optional("ray", "ray", "cluster", "The executor 'ray'")
    return _run(ray, function, tasks, jobs, on_progress)


def _run(ray: Any, function: Callable[[Any, Tell], Any], tasks: Sequence[Any], jobs: int, on_progress: Callable[[int, float], None]) -> Iterator[Any]:
    with _cluster(ray, jobs):
        board = ray.remote(num_cpus=0)(_Board).remote()
        # Ray tries again where the process is gone; an error of the task itself is its outcome.
        remote = ray.remote(max_retries=ATTEMPTS - 1)(_work)
        running = {remote.remote(function, task, number, board): number for number, task in enumerate(tasks)}
        try:
            while running:
                done, _ = ray.wait(list(running), timeout=_POLL_S)
                for number, share in ray.get(board.take.remote()):
                    on_progress(number, share)
                for reference in done:
                    number = running.pop(reference)
                    yield number, _outcome(ray, reference)
        finally:
            for reference in running:
                ray.cancel(reference)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=_GRACE_S)


@contextmanager
def _cluster(ray: Any, jobs: int) -> Iterator[None]:
    """Connected to a cluster; one that the caller is connected to already is used, and left connected."""
    if ray.is_initialized():
        yield
        return
    address = os.environ.get("RAY_ADDRESS", "local")
    _check_reachable(address)
    # A cluster of our own tells nobody that it is there.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    own = {"num_cpus": jobs, "include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address, log_to_driver=False, logging_level="error", **own)
    except (ConnectionError, ValueError) as error:
        raise _unreachable(address, error) from error
    try:
        yield
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise :class:`ConfigError` where nobody listens at ``HOST:PORT``: Ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), _CONNECT_S).close()
    except OSError as error:
        raise _unreachable(address, error) from error


def _unreachable(address: str, error: Exception) -> ConfigError:
    return ConfigError(f"executor: no Ray cluster can be reached at RAY_ADDRESS={address} ({error}). Correct it, or unset it.")


class _Board:
    """Where tasks say how far they are, until it is read."""

    def __init__(self) -> None:
        self._shares: list[tuple[int, float]] = []

    def tell(self, number: int, share: float) -> None:
        self._shares.append((number, share))

    def take(self) -> list[tuple[int, float]]:
        shares, self._shares = self._shares, []
        return shares


def _work(function: Callable[[Any, Tell], Any], task: Any, number: int, board: Any) -> Any:
    """What one machine does with one task."""
    import ray

    sent: list[Any] = []
    result = attempt(function, task, lambda share: sent.append(board.tell.remote(number, share)))
    # A task is not done before what it told has arrived.
    ray.get(sent)
    return result


def _outcome(ray: Any, reference: Any) -> Any:
    try:
        return ray.get(reference)
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError, ray.exceptions.NodeDiedError) as error:
        return killed(f"so: {error}")
    except ray.exceptions.RayError as error:
        return TaskFailure(reason_of(error))

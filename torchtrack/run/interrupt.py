"""Being told to end: at the end of a window instead of in the middle of one, or at once but in good order."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, NoReturn

# Ctrl-C; what `kill`, systemd, Docker and Slurm send; a terminal that is closed, which Windows knows nothing of.
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Interrupt:
    """Within its block, the first Ctrl-C, SIGTERM or SIGHUP only sets :attr:`requested`; a second one does what it did before.

    Outside the main thread, where Python takes no signals, it does nothing.
    """

    def __init__(self) -> None:
        self.requested = False
        self.reason = ""
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Interrupt":
        self._previous = _taken(_SIGNALS, self._request)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        _put_back(self._previous)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested, self.reason = True, f"ended by {signal.Signals(number).name}"
        signal.signal(number, self._previous[number])


@contextmanager
def ended_in_good_order() -> Iterator[None]:
    """Within the block, SIGTERM and SIGHUP are as Ctrl-C: what is half written is taken away on the way out."""
    previous = _taken(_SIGNALS[1:], _interrupt)
    try:
        yield
    finally:
        _put_back(previous)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _taken(numbers: tuple[int, ...], handler: Callable[[int, FrameType | None], Any]) -> dict[int, Any]:
    """Have signals call a handler; what each did before. One that is to be ignored, as under ``nohup``, still is."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    taken = [number for number in numbers if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in taken}


def _put_back(previous: dict[int, Any]) -> None:
    for number, handler in previous.items():
        signal.signal(number, handler)

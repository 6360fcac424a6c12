"""Values that are computed once, in whatever thread asks first: another thread may have them ready before they are asked for."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any, Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Later(Generic[T]):
    """A value that is there once somebody has asked for it. What is pickled or copied is the value.

    Args:
        compute: gives it, or raises what everybody who asks is to get; in the context that this is made in.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self._lock = threading.Lock()
        self._compute: Callable[[], T] | None = partial(copy_context().run, compute)
        self._before: Later[Any] | None = None
        self._value: Any = None

    def then(self, change: Callable[[T], R]) -> "Later[R]":
        """What a function makes of the value, later. Many may be made of one another: they are computed one after the other."""
        later = Later(lambda: change(self.value()))
        later._before = self
        return later

    def value(self) -> T:
        """The value, for which is waited where another thread computes it."""
        missing: list[Later[Any]] = [self]
        while (before := missing[-1]._before) is not None:
            missing.append(before)
        for later in reversed(missing):
            later._settle()
        value: T = self._value
        return value

    def _settle(self) -> None:
        with self._lock:
            if self._compute is not None:
                self._value = self._compute()
                # What it was made of is not needed any more.
                self._compute = self._before = None

    def __getstate__(self) -> dict[str, Any]:
        return {"value": self.value()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._lock, self._compute, self._before, self._value = threading.Lock(), None, None, state["value"]


class Ahead:
    """A thread that computes values before they are asked for, in the order in which they are handed to it. A copy has a thread of its own."""

    def __init__(self) -> None:
        self._threads: ThreadPoolExecutor | None = None
        self._process = 0

    def compute(self, later: Later[Any]) -> None:
        """Have a value computed once those before it are. What goes wrong then is raised where the value is asked for."""
        if self._threads is None or self._process != os.getpid():
            # The threads of a process are not those of one that was forked from it.
            self._threads, self._process = ThreadPoolExecutor(max_workers=1, thread_name_prefix="torchtrack"), os.getpid()
        self._threads.submit(later.value)

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._threads, self._process = None, 0

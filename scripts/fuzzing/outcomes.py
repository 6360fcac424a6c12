"""What came of one input, and how it is found out: in a process of its own, with limits of time and memory."""

import os
import re
import resource
import select
import shutil
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchtrack.errors import TorchtrackError, TorchtrackWarning

MEMORY_BYTES = 2 << 30
CPU_S, WALL_S = 20.0, 120.0
_TICKS = os.sysconf("SC_CLK_TCK")
# Faults in the order in which they are told.
FAULTS = ("traceback", "hang", "memory", "unnamed")


@dataclass(frozen=True)
class Input:
    """One file, or what stands in its place, to be read.

    Args:
        name: its number or its name.
        prepare: puts it into a folder and returns what is to be opened.
        read: opens and reads it.
        names: any of these in an error tells a user which file is meant.
    """

    name: str
    prepare: Callable[[Path], Path]
    read: Callable[[Path], None]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What came of an input: ``result``, ``clear error``, or one of the faults, with how it was told."""

    name: str
    kind: str
    detail: str = ""
    seconds: float = 0.0


def outcomes(inputs: Sequence[Input], folder: Path, jobs: int) -> Iterator[Outcome]:
    """The outcome of every input, as it comes; ``jobs`` processes work on them in turn."""
    parts = [list(inputs[number::jobs]) for number in range(jobs)]
    workers = [_Worker(part, folder / f"worker{number}") for number, part in enumerate(parts) if part]
    for worker in workers:
        worker.start()
    while workers:
        ready, _, _ = select.select([worker.pipe for worker in workers], [], [], 0.5)
        for worker in list(workers):
            yield from worker.received() if worker.pipe in ready else worker.overdue()
            if worker.is_done:
                worker.finish()
                workers.remove(worker)


class _Worker:
    """A process that reads one input after the other, and is started again behind one that it does not survive."""

    def __init__(self, inputs: list[Input], folder: Path) -> None:
        self._inputs, self._folder, self._at, self._pid = inputs, folder, 0, 0
        self._rest, self._begun, self._cpu_before = b"", 0.0, 0.0
        self.pipe = -1

    @property
    def is_done(self) -> bool:
        return self._at >= len(self._inputs)

    def start(self) -> None:
        """Fork a process that goes on at the input at hand."""
        self.pipe, end = os.pipe()
        self._pid = os.fork()
        if self._pid == 0:
            os.close(self.pipe)
            _work(self._inputs[self._at :], self._folder, end)
        os.close(end)
        self._rest, self._begun, self._cpu_before = b"", time.monotonic(), 0.0

    def received(self) -> Iterator[Outcome]:
        """What the process has told; if it has ended on an input, that was a crash."""
        data = os.read(self.pipe, 1 << 16)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            kind, seconds, detail = line.decode().split("\t", 2)
            yield Outcome(self._inputs[self._at].name, kind, detail.replace("\\n", "\n"), float(seconds))
            self._next()
        if not data and not self.is_done:
            self.finish()
            status = os.WTERMSIG(self._status) if os.WIFSIGNALED(self._status) else self._status
            yield Outcome(self._inputs[self._at].name, "traceback", f"the process ended with status or signal {status}")
            self._next()
            if not self.is_done:
                self.start()

    def overdue(self) -> Iterator[Outcome]:
        """A hang, if the input at hand takes too long."""
        waited, used = time.monotonic() - self._begun, self._cpu_s() - self._cpu_before
        if used < CPU_S and waited < WALL_S and not (waited > 30 and used < 0.01):
            return
        os.kill(self._pid, signal.SIGKILL)
        self.finish()
        yield Outcome(self._inputs[self._at].name, "hang", f"{used:.0f} s of the processor, {waited:.0f} s in all", waited)
        self._next()
        if not self.is_done:
            self.start()

    def finish(self) -> None:
        """Close what is open of the process."""
        if self.pipe >= 0:
            os.close(self.pipe)
            _, self._status = os.waitpid(self._pid, 0)
            self.pipe = -1

    def _next(self) -> None:
        self._at, self._begun = self._at + 1, time.monotonic()
        self._cpu_before = self._cpu_s() if self.pipe >= 0 else 0.0

    def _cpu_s(self) -> float:
        try:
            fields = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            return self._cpu_before
        return (int(fields[11]) + int(fields[12])) / _TICKS


def _work(inputs: Sequence[Input], folder: Path, pipe: int) -> None:
    """Read all inputs, tell what came of each, and end the process."""
    warnings.simplefilter("ignore")
    # A number that overflows on the way is a wrong result.
    warnings.simplefilter("error", RuntimeWarning)
    warnings.simplefilter("ignore", TorchtrackWarning)
    data_bytes = _status_bytes("VmData")
    resource.setrlimit(resource.RLIMIT_DATA, (data_bytes + MEMORY_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for item in inputs:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        os.chdir(folder)
        path = item.prepare(folder)
        Path("/proc/self/clear_refs").write_text("5")
        before = _status_bytes("VmRSS")
        start = time.process_time()
        kind, detail = _outcome(item, path)
        used = _status_bytes("VmHWM") - before
        if used > MEMORY_BYTES:
            kind, detail = "memory", f"{used >> 20} MiB; {detail}"
        line = f"{kind}\t{time.process_time() - start:.3f}\t{detail}".replace("\n", "\\n")
        os.write(pipe, line.encode("utf-8", errors="replace")[:60_000] + b"\n")
    os._exit(0)


def _outcome(item: Input, path: Path) -> tuple[str, str]:
    try:
        item.read(path)
    except TorchtrackError as error:
        is_named = any(name in str(error) for name in item.names)
        return ("clear error" if is_named else "unnamed"), f"{type(error).__name__}: {error}"
    except MemoryError as error:
        return "memory", _trace(error)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is counted
        return ("memory" if _lacks_memory(error) else "traceback"), _trace(error)
    return "result", ""


def _lacks_memory(error: BaseException | None) -> bool:
    """Whether memory ran out on the way to an error."""
    while error is not None:
        if isinstance(error, MemoryError) or re.search(r"can't allocate|Unable to allocate|not enough memory", str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error))[-4000:]


def _status_bytes(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) << 10
    return 0

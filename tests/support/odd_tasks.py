"""Tasks that do what tasks do: succeed, fail, tell how far they are, take their process down, or never end."""

import os
import signal
import sys
import time
from pathlib import Path

from torchtrack.errors import ConfigError
from torchtrack.run.executor import run_tasks


def do(task, tell):
    """``task`` is what to do, and a value for it."""
    what, value = task
    if what == "double":
        return 2 * value
    if what == "tell":
        for share in value:
            tell(share)
            time.sleep(0.5)
        return os.getpid()
    if what == "error":
        raise ConfigError(value)
    if what == "bug":
        return 1 / value
    if what == "killed once":
        if not value.exists():
            value.write_text("")
            os.kill(os.getpid(), signal.SIGKILL)
        return "survived"
    if what == "killed":
        with value.open("a") as file:
            file.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "write for ever":
        # Here, so that the processes of the other tasks start quickly.
        from torchtrack.core.atomic import atomic_path

        with atomic_path(value) as path:
            path.write_text(str(os.getpid()))
            (value.parent / f"{value.stem}.begun").write_text(str(os.getpid()))
            for _ in range(6000):
                time.sleep(0.1)
    return None


if __name__ == "__main__":
    executor, folder = sys.argv[1], Path(sys.argv[2])
    list(run_tasks(do, [("write for ever", folder / f"{number}.txt") for number in range(3)], executor, jobs=2))

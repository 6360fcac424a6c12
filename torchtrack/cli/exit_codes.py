"""What the command line's exit codes mean."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command."""

    DONE = 0
    FAILED = 1
    WRONG_SETTINGS = 2
    NOT_TRACKED = 3
    INTERRUPTED = 130

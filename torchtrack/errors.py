"""Every error and warning that torchtrack raises on purpose.

::

    TorchtrackError
    ├── ConfigError           (ValueError)         a setting is missing, unknown or out of bounds
    ├── MissingFileError      (FileNotFoundError)  a file that was named is not there
    ├── UnknownFormatError    (ValueError)         a file whose format is not known
    ├── EventDataError        (ValueError)         events that are unsorted, outside the sensor, or malformed
    ├── CalibrationError      (ValueError)         intrinsics or distortion that make no sense
    ├── ModelError            (ValueError)         an object model that cannot be tracked
    ├── PoseError             (ValueError)         a matrix that is not a pose, or an object that cannot be seen
    ├── LimitError            (ValueError)         a file that asks for more than a stated limit
    ├── OutputError           (OSError)            results cannot be written where they were to go
    └── MissingExtraError     (ImportError)        an optional library is not installed

    TorchtrackWarning         (UserWarning)        work goes on, but something should be looked at

Messages say what was wrong, what was expected, what was got, and how to fix it.
"""


class TorchtrackError(Exception):
    """Base of every error that torchtrack raises on purpose."""


class ConfigError(TorchtrackError, ValueError):
    """A setting is missing, unknown or out of bounds."""


class MissingFileError(TorchtrackError, FileNotFoundError):
    """A file that was named is not there."""


class UnknownFormatError(TorchtrackError, ValueError):
    """A file whose format is not known."""


class EventDataError(TorchtrackError, ValueError):
    """Events that are unsorted, outside the sensor, or malformed."""


class CalibrationError(TorchtrackError, ValueError):
    """Intrinsics or distortion that make no sense."""


class ModelError(TorchtrackError, ValueError):
    """An object model that cannot be tracked."""


class PoseError(TorchtrackError, ValueError):
    """A matrix that is not a pose, or an object that cannot be seen."""


class LimitError(TorchtrackError, ValueError):
    """A file that asks for more than a stated limit; see :mod:`torchtrack.core.limits`."""


class OutputError(TorchtrackError, OSError):
    """Results cannot be written where they were to go."""


class MissingExtraError(TorchtrackError, ImportError):
    """An optional library is not installed."""

    def __init__(self, library: str, extra: str, purpose: str) -> None:
        """Name the ``library`` that is missing, the ``extra`` that brings it and the ``purpose`` it serves."""
        super().__init__(f"{purpose} needs the library '{library}', which is not installed. Install it with: pip install 'torchtrack[{extra}]'")


class TorchtrackWarning(UserWarning):
    """Work goes on, but something should be looked at."""

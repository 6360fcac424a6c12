"""Warnings about model files."""

import warnings

from torchtrack.errors import TorchtrackWarning


def tell(message: str) -> None:
    """Warn (:class:`TorchtrackWarning`) of something in a model that should be looked at."""
    warnings.warn(message, TorchtrackWarning, stacklevel=6)

"""Optional libraries: imported when they are needed, with an error that says how to install them."""

import importlib
from typing import Any

from torchtrack.errors import MissingExtraError


def optional(module: str, library: str, extra: str, purpose: str) -> Any:
    """The module of an optional library.

    Raises:
        MissingExtraError: if it is not installed; the message names the ``extra`` that brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(library, extra, purpose) from error

"""Pictures that a command writes beside what it says."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from torchtrack.core.atomic import atomic_path, check_writable
from torchtrack.errors import UnknownFormatError


def check_picture(path: Path) -> None:
    """Refuse a picture that could not be written, before it is drawn.

    Raises:
        UnknownFormatError: if it is no ``.png`` file.
        OutputError: if it cannot be written.
    """
    if path.suffix.lower() != ".png":
        raise UnknownFormatError(f"'{path}': pictures are .png files. Give it such a name.")
    check_writable(path)


def write_picture(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture (BGR); the file appears whole or not at all.

    Raises:
        OutputError: if it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", image)[1].tobytes())

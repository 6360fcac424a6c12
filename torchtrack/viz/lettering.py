"""Text that is legible on events: one colour on a dark ground."""

import cv2
import numpy as np
from jaxtyping import UInt8

Colour = tuple[int, int, int]

_FONT, _SIZE, _LINE_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.55, 22
# How much of the picture shows through the ground, and how far that reaches beyond the letters.
_SHINES_THROUGH, _MARGIN_PX = 0.25, 4


def write(image: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int], colour: Colour) -> None:
    """Write a line of text into a picture (BGR); ``at``: the left end of its base line.

    Letters are drawn once, and their ground is what they cover: versions of OpenCV draw other letters, and wider ones not on narrower ones.
    """
    strip = image[max(at[1] - _LINE_PX, 0) : max(at[1] + _LINE_PX // 2, 0)]
    letters = np.zeros(strip.shape[:2], dtype=np.uint8)
    if letters.size == 0:
        return
    cv2.putText(letters, text, (at[0], min(at[1], _LINE_PX)), _FONT, _SIZE, 255, 1, cv2.LINE_AA)
    left, top, width, height = cv2.boundingRect(letters)
    if width == 0:
        return
    rows, columns = (slice(max(start - _MARGIN_PX, 0), start + size + _MARGIN_PX) for start, size in ((top, height), (left, width)))
    share = letters[rows, columns, None].astype(np.float32) / 255
    ground = _SHINES_THROUGH * strip[rows, columns].astype(np.float32)
    strip[rows, columns] = np.round(ground + share * (np.array(colour, dtype=np.float32) - ground)).astype(np.uint8)


def write_lines(image: UInt8[np.ndarray, "h w 3"], lines: list[tuple[str, Colour]]) -> None:
    """Write lines of text into the upper left corner."""
    for number, (text, colour) in enumerate(lines):
        write(image, text, (8, _LINE_PX * (number + 1)), colour)

"""Whole numbers in text, read by operations on all of its bytes at once."""

import numpy as np

# More digits than these may overflow.
MOST_DIGITS = 18


def digits(data: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Integers written in ``data[starts:ends]``."""
    lengths = ends - starts
    value = np.zeros(len(starts), dtype=np.int64)
    for place in range(int(lengths.max(initial=0))):
        digit = data[starts + place] - np.uint8(ord("0"))
        value = np.where(place < lengths, 10 * value + digit, value)
    return value


def whole_numbers(block: bytes, columns: int) -> list[np.ndarray] | None:
    """Columns of whole numbers between commas, from whole lines; None if there is anything else in the text, or a line of another length."""
    # Padding: digits are looked up at fixed places, which may lie past the last line.
    padded = np.frombuffer(block.rstrip(b"\r\n") + b"\n" + b" " * MOST_DIGITS, np.uint8)
    data = padded[:-MOST_DIGITS]
    is_digit = (data - np.uint8(ord("0"))) < 10
    borders = np.flatnonzero(is_digit[1:] != is_digit[:-1]) + 1
    if is_digit[0]:
        borders = np.concatenate([[0], borders])
    newlines, commas = np.flatnonzero(data == ord("\n")), int(np.count_nonzero(data == ord(",")))
    rows = len(newlines)
    others = len(data) - int(np.count_nonzero(is_digit)) - rows - commas - int(np.count_nonzero(data == ord("\r")))
    if others or len(borders) != 2 * columns * rows or commas != (columns - 1) * rows:
        return None
    starts, ends = borders[0::2].reshape(rows, columns), borders[1::2].reshape(rows, columns)
    if not ((starts[1:, 0] > newlines[:-1]).all() and (ends[:, -1] <= newlines).all() and (ends - starts).max() <= MOST_DIGITS):
        return None
    return [digits(padded, starts[:, column], ends[:, column]) for column in range(columns)]

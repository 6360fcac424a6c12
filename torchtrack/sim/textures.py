"""Printed textures, drawn by code: grey images ``[height, width]`` of sRGB values 0..255, deterministic."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

Image = UInt8[ndarray, "_ _"]

# Reflectances of print: paper about 75 %, ink about 7 %.
PAPER, GREY, INK = 225, 150, 75
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def _paper(height: int, width: int) -> Image:
    return np.full((height, width), PAPER, dtype=np.uint8)


def checker(size: int) -> Image:
    """A checkerboard of 4 x 4 fields."""
    field = np.arange(size) * 4 // size
    return np.where((field[:, None] + field) % 2 == 0, PAPER, INK).astype(np.uint8)


def target(size: int) -> Image:
    """Concentric squares and a disc off the centre."""
    image = _paper(size, size)
    for share, value in ((0.84, INK), (0.66, PAPER), (0.46, GREY), (0.26, INK)):
        half = int(size * share / 2)
        cv2.rectangle(image, (size // 2 - half, size // 2 - half), (size // 2 + half, size // 2 + half), value, -1)
    cv2.circle(image, (size // 4, size // 4), size // 10, GREY, -1, cv2.LINE_AA)
    return image


def stripes(size: int) -> Image:
    """Diagonal stripes of growing width."""
    row, col = np.mgrid[:size, :size]
    phase = ((row + col) / (2 * size)) ** 1.3 * 5
    return np.where(phase % 1 < 0.5, INK, PAPER).astype(np.uint8)


def letter(size: int, text: str = "R") -> Image:
    """One large letter in a frame."""
    image = _paper(size, size)
    border = size // 12
    cv2.rectangle(image, (border, border), (size - border, size - border), INK, max(1, size // 24))
    scale = size / 60
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, size // 12)
    cv2.putText(image, text, ((size - width) // 2, (size + height) // 2), _FONT, scale, INK, size // 12, cv2.LINE_AA)
    return image


def discs(size: int) -> Image:
    """Five discs, as on a die, of different sizes."""
    image = _paper(size, size)
    for u, v, radius in ((0.25, 0.25, 0.12), (0.75, 0.25, 0.08), (0.5, 0.5, 0.14), (0.25, 0.75, 0.08), (0.75, 0.75, 0.12)):
        cv2.circle(image, (int(u * size), int(v * size)), int(radius * size), INK, -1, cv2.LINE_AA)
    return image


def cross(size: int) -> Image:
    """Two crossing bars and a grey quarter."""
    image = _paper(size, size)
    image[: size // 2, : size // 2] = GREY
    cv2.line(image, (0, 0), (size, size), INK, size // 10)
    cv2.line(image, (size, 0), (0, size), INK, size // 16)
    return image


def text_page(height: int, width: int, seed: int = 0, title: str = "TORCHTRACK") -> Image:
    """A printed page: a title, lines of words as dark bars, and a framed picture."""
    rng = np.random.default_rng(seed)
    image = _paper(height, width)
    margin, line = width // 12, height // 22
    scale = (width - 2 * margin) / cv2.getTextSize(title, _FONT, 1.0, 2)[0][0]
    cv2.putText(image, title, (margin, margin + 2 * line), _FONT, scale, INK, max(2, width // 120), cv2.LINE_AA)
    top = margin + 3 * line
    cv2.rectangle(image, (margin, top), (width // 2, top + 5 * line), GREY, -1)
    cv2.circle(image, (width // 4 + margin // 2, top + 5 * line // 2), 2 * line, INK, -1, cv2.LINE_AA)
    for row in range(top, height - margin, line):
        col = width // 2 + margin // 2 if row < top + 6 * line else margin
        while (end := col + int(rng.integers(width // 24, width // 8))) < width - margin:
            image[row : row + line // 2, col:end] = INK
            col = end + width // 48
    return image


def page_edges(height: int, width: int) -> Image:
    """The cut edges of many pages: fine lines, a few of them dark."""
    lines = np.full(height, PAPER, dtype=np.uint8)
    lines[:: max(2, height // 7)] = GREY
    return np.repeat(lines[:, None], width, axis=1)


def spine(height: int, width: int) -> Image:
    """The back of a book: dark, with two light bands."""
    image = np.full((height, width), INK, dtype=np.uint8)
    for share in (0.2, 0.75):
        image[:, int(share * width) : int((share + 0.06) * width)] = PAPER
    return image


def solar_cells(height: int, width: int) -> Image:
    """A solar panel: dark cells between light lines."""
    image = np.full((height, width), INK, dtype=np.uint8)
    cell = height // 3
    gap = max(2, height // 40)
    for start in range(0, height, cell):
        image[start : start + gap] = PAPER
    for start in range(0, width, cell):
        image[:, start : start + gap] = PAPER
    image[-gap:], image[:, -gap:] = PAPER, PAPER
    return image


def foil(height: int, width: int) -> Image:
    """The body of a satellite: light foil with a grey seam and a round port."""
    image = np.full((height, width), 200, dtype=np.uint8)
    image[:, width // 3 : width // 3 + max(2, width // 30)] = GREY
    cv2.circle(image, (2 * width // 3, height // 2), height // 6, INK, -1, cv2.LINE_AA)
    return image


def planar_pattern(size: int) -> Image:
    """Dark shapes on paper, as printed for calibration by hand: polygons, a disc, a star, bars."""
    image = _paper(size, size)
    shapes = [
        [(0.10, 0.12), (0.32, 0.08), (0.36, 0.30), (0.14, 0.34)],
        [(0.52, 0.10), (0.66, 0.34), (0.44, 0.32)],
        [(0.10, 0.60), (0.30, 0.52), (0.38, 0.70), (0.26, 0.88), (0.10, 0.80)],
        [(0.48, 0.62), (0.56, 0.62), (0.56, 0.54), (0.64, 0.54), (0.64, 0.62), (0.72, 0.62), (0.72, 0.70), (0.48, 0.70)],
        [(0.50, 0.80), (0.92, 0.84), (0.92, 0.90), (0.50, 0.88)],
    ]
    for shape in shapes:
        cv2.fillPoly(image, [np.rint(16 * size * np.array(shape)).astype(np.int32)], INK, cv2.LINE_AA, 4)
    angle = np.pi * np.arange(10) / 5
    star = np.stack(
        [0.84 + 0.1 * np.where(np.arange(10) % 2, 0.45, 1) * np.sin(angle), 0.52 - 0.1 * np.where(np.arange(10) % 2, 0.45, 1) * np.cos(angle)], 1
    )
    cv2.fillPoly(image, [np.rint(16 * size * star).astype(np.int32)], INK, cv2.LINE_AA, 4)
    cv2.circle(image, (int(0.82 * size), int(0.22 * size)), int(0.11 * size), INK, -1, cv2.LINE_AA)
    return image


def clutter(height: int, width: int, seed: int = 0) -> Image:
    """A messy picture: overlapping polygons, discs, rings, lines and words of all sizes and greys on uneven ground."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(60, 190, (max(2, height // 120), max(2, width // 120))).astype(np.float32)
    image = np.rint(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255)).astype(np.uint8)
    # As many per area whatever the size, so that the same picture can be larger and not emptier.
    for _ in range(max(12, height * width // 2600)):
        _scribble(image, rng, (int(rng.uniform(0, width)), int(rng.uniform(0, height))), 8 + rng.exponential(18), int(rng.uniform(20, 240)))
    return image


def _scribble(image: Image, rng: np.random.Generator, centre: tuple[int, int], size: float, grey: int) -> None:
    """One thing of a messy picture, drawn into the image."""
    kind, thickness = rng.choice(["polygon", "disc", "ring", "line", "word"], p=[0.4, 0.15, 0.1, 0.2, 0.15]), 1 + int(rng.integers(4))
    if kind == "polygon":
        angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        corners = np.array(centre) + size * np.stack([np.cos(angle), np.sin(angle)], 1)
        cv2.fillPoly(image, [np.rint(16 * corners).astype(np.int32)], grey, cv2.LINE_AA, 4)
    elif kind == "line":
        end = np.array(centre) + 3 * size * rng.normal(size=2)
        cv2.line(image, centre, (int(end[0]), int(end[1])), grey, thickness, cv2.LINE_AA)
    elif kind == "word":
        word = "".join(rng.choice(list("AEIORSTNKLM"), rng.integers(2, 7)))
        cv2.putText(image, word, centre, _FONT, size / 30, grey, max(1, int(size / 14)), cv2.LINE_AA)
    else:
        cv2.circle(image, centre, int(size * 0.7), grey, -1 if kind == "disc" else thickness, cv2.LINE_AA)


CUBE_FACES: tuple[Callable[[int], Image], ...] = (checker, target, stripes, letter, discs, cross)

"""Polyline models from a picture: the outlines of dark shapes on a bright plane that faces the camera."""

import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from torchtrack.cli.console import output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.core.atomic import atomic_path, check_other_file
from torchtrack.core.camera import Camera, undistort
from torchtrack.errors import MissingFileError, ModelError, UnknownFormatError
from torchtrack.io import read_calibration

# The picture is enlarged before it is thresholded: edges are then found to a fraction of a pixel.
_ENLARGEMENT = 8


# Pixels at the picture's border are no part of the scene in some cameras, and a shape cut off there has no edge there.
_BORDER_PX = 2.5


_MIN_AREA_PX = 30


def read_grey_image(path: Path) -> UInt8[ndarray, "h w"]:
    """A picture as grey values.

    Raises:
        MissingFileError: if it is not there.
        UnknownFormatError: if it is no picture.
    """
    if not path.is_file():
        raise MissingFileError(f"no picture at {path}. Check the path.")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise UnknownFormatError(f"'{path}' cannot be read as a picture. Use PNG or JPEG.")
    return np.asarray(image, np.uint8)


def outline_dark_shapes(image: UInt8[ndarray, "h w"], camera: Camera, distance_m: float, tolerance_px: float = 0.5) -> list[Float[ndarray, "_ 3"]]:
    """Outlines of the dark shapes of a picture, on the plane z = 0 of an object that is ``distance_m`` before the camera.

    With that object at the pose of no rotation and translation ``(0, 0, distance_m)``, the outlines lie on the picture.

    Args:
        image: what the camera saw.
        camera: the camera, whose distortion is taken out.
        distance_m: of the plane, which faces the camera. Only ratios matter where the size is not known.
        tolerance_px: how far the outlines may leave the edges of the shapes.

    Raises:
        ModelError: if the picture is not of the camera's size, or has no dark shape.
    """
    if image.shape != (camera.height, camera.width):
        raise ModelError(
            f"the picture is {image.shape[1]}x{image.shape[0]} pixels, the camera {camera.width}x{camera.height}. Use a picture of its own."
        )
    lines = [undistort(line, camera) for contour in _dark_contours(image) for line in _inside(_simplified(contour, tolerance_px), image.shape)]
    if not lines:
        raise ModelError("the picture has no dark shape on a bright ground of at least 30 pixels. Use one with more contrast.")
    rays = [(line - [camera.cx, camera.cy]) / [camera.fx, camera.fy] for line in lines]
    return [np.concatenate([distance_m * ray, np.zeros((len(ray), 1))], 1) for ray in rays]


def _dark_contours(image: UInt8[ndarray, "h w"]) -> list[Float[ndarray, "_ 2"]]:
    """Closed contours of dark regions, in pixels, without repeating the first point."""
    large = cv2.resize(image, None, fx=_ENLARGEMENT, fy=_ENLARGEMENT, interpolation=cv2.INTER_CUBIC)
    dark = (large < _edge_level(image)).astype(np.uint8)
    edge = round(_BORDER_PX * _ENLARGEMENT / 2)
    dark[:edge], dark[-edge:], dark[:, :edge], dark[:, -edge:] = 0, 0, 0, 0
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    big = [contour[:, 0] for contour in contours if cv2.contourArea(contour) >= _MIN_AREA_PX * _ENLARGEMENT**2]
    # Pixel centres: the large pixel i covers the small pixels' coordinates around (i + 0.5) / enlargement - 0.5.
    return [(contour + 0.5) / _ENLARGEMENT - 0.5 for contour in big]


def _edge_level(image: UInt8[ndarray, "h w"]) -> float:
    """The grey halfway between dark and bright, which is where an edge is; Otsu's threshold tells the two apart."""
    threshold, _ = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    bright: ndarray = np.greater(image, threshold)
    return float(image[bright].mean() + image[~bright].mean()) / 2 if bright.any() and not bright.all() else 0.0


def _simplified(contour: Float[ndarray, "n 2"], tolerance_px: float) -> Float[ndarray, "m 2"]:
    """A closed polygon near the contour, its first point repeated at its end."""
    polygon = cv2.approxPolyDP(contour[:, None].astype(np.float32), tolerance_px, True)[:, 0].astype(np.float64)
    return np.concatenate([polygon, polygon[:1]])


def _inside(line: Float[ndarray, "n 2"], shape: tuple[int, ...]) -> list[Float[ndarray, "_ 2"]]:
    """The parts of a line away from the picture's border: along it run cuts, not edges."""
    limit = np.array([shape[1], shape[0]]) - 1 - _BORDER_PX
    near_border: ndarray = np.any((line < _BORDER_PX) | (line > limit), axis=1)
    cut = near_border[:-1] & near_border[1:]
    parts = np.split(np.arange(len(line)), np.flatnonzero(cut) + 1)
    return [line[part] for part in parts if len(part) >= 2]


def write_polylines(path: Path, lines: list[Float[ndarray, "_ 3"]]) -> None:
    """Write polylines (m) as the JSON file that :meth:`ObjectModel.from_polylines` reads."""
    with atomic_path(path) as temporary:
        rows = ",\n  ".join(json.dumps(np.round(line, 6).tolist()) for line in lines)
        temporary.write_text(f'{{"unit": "m", "polylines": [\n  {rows}\n]}}\n', encoding="utf-8")


def outline(image: str, calibration: str, output: str, distance_m: float, width: int | None, height: int | None) -> int:
    """Write a polyline model of the dark shapes of a picture; returns the exit code."""
    for source in (image, calibration):
        check_other_file(Path(source), Path(output))
    camera = read_calibration(calibration, width, height)
    lines = outline_dark_shapes(read_grey_image(Path(image)), camera, distance_m)
    write_polylines(Path(output), lines)
    output_console().print(f"{len(lines)} outlines are in {output}")
    return ExitCode.DONE

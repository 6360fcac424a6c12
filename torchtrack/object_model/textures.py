"""Images of textures: made 8-bit RGB whatever their pixels, checked for size, and said when they cannot be used."""

import io
import struct
import zlib
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from torchtrack.core.limits import check_limit
from torchtrack.object_model.notices import tell
from torchtrack.object_model.side_files import MeshText

# What Pillow's decoders raise on damaged data.
IMAGE_ERRORS: tuple[type[Exception], ...] = (
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, MemoryError, NotImplementedError, OverflowError, AttributeError),
    *(struct.error, zlib.error, Image.DecompressionBombError),
)
_SLOTS = ("baseColorTexture", "image")


class UnreadableImageError(Exception):
    """An image that cannot be used; says why."""


def material_image(mesh: trimesh.Trimesh) -> Image.Image | None:
    """The colour image of the mesh's material, whether the mesh can use it or not."""
    material = getattr(mesh.visual, "material", None)
    return next((image for image in (getattr(material, slot, None) for slot in _SLOTS) if image is not None), None)


def set_material_image(mesh: trimesh.Trimesh, image: Image.Image | None) -> None:
    """Give the mesh's material a colour image, or take it away."""
    material: Any = getattr(mesh.visual, "material", None)
    slot = next((slot for slot in _SLOTS if hasattr(material, slot)), None)
    if slot is not None:
        setattr(material, slot, image)


def has_uv(mesh: trimesh.Trimesh) -> bool:
    """Whether every vertex has texture coordinates."""
    uv = getattr(mesh.visual, "uv", None)
    return uv is not None and np.shape(uv) == (len(mesh.vertices), 2)


def texture_image(mesh: trimesh.Trimesh) -> Image.Image | None:
    """The colour image of a mesh that has one and can use it (with one UV coordinate per vertex)."""
    return material_image(mesh) if has_uv(mesh) else None


def as_rgb(image: Image.Image) -> np.ndarray:
    """An image of any kind as 8-bit RGB ``[h, w, 3]``.

    Raises:
        UnreadableImageError: if its data are damaged, or its values have no known range, as those of HDR images.
    """
    _decode(image)
    try:
        if image.mode == "I" or image.mode.startswith("I;16"):
            return _from_16_bits(np.asarray(image))
        if image.mode == "P" and "transparency" in image.info:
            image = image.convert("RGBA")
        return np.asarray(image.convert("RGB"))
    except IMAGE_ERRORS as error:
        raise UnreadableImageError(f"its data are damaged: {error}") from error


def _decode(image: Image.Image) -> None:
    """Have the image's data read.

    Raises:
        UnreadableImageError: as :func:`as_rgb`.
    """
    if image.mode == "F":
        raise UnreadableImageError("its pixels are floats, whose range is not known; save it as an 8-bit PNG")
    try:
        image.load()
    except IMAGE_ERRORS as error:
        raise UnreadableImageError(f"its data are damaged ({error})") from error


def _from_16_bits(grey: np.ndarray) -> np.ndarray:
    """Grey of 16 bits, which Pillow would clip at 255, as 8-bit RGB."""
    return np.repeat((np.asarray(grey).astype(np.int64).clip(0, 65_535) >> 8).astype(np.uint8)[..., None], 3, -1)


def check_textures(parts: Sequence[trimesh.Trimesh], where: str) -> None:
    """Refuse textures that are too large together, before any is decoded.

    Raises:
        LimitError: if they have more pixels than ``limits.texture_pixels``.
    """
    images = {id(image): image for image in map(material_image, parts) if image is not None}
    check_limit("texture_pixels", sum(image.width * image.height for image in images.values()), where)


def tell_lost_textures(path: Path, text: MeshText, parts: Sequence[trimesh.Trimesh], missing: Set[str]) -> None:
    """Warn of every image that the file ``text`` names and some parts do not get, and why; those that are ``missing`` have been told.

    An image that cannot be used is taken from its parts, so that what is left are those that can.
    """
    lost: dict[tuple[str, str], int] = {}
    for part in parts:
        name = text.images.get("") or text.images.get(str(getattr(getattr(part.visual, "material", None), "name", "")))
        if name is None or name in missing:
            continue
        if "" in text.images:
            set_material_image(part, _opened(text, name))
            check_textures([part], str(path))
        why = _why_lost(part)
        if why is not None:
            set_material_image(part, None)
            lost[name, why] = lost.get((name, why), 0) + 1
    for (name, why), count in lost.items():
        which = f"'{name}'" if count == len(parts) else f"'{name}', of {count} of {len(parts)} parts"
        tell(f"the texture of '{path}' cannot be read: only the geometry is used. It is {which}: {why}.")


def _opened(text: MeshText, name: str) -> Image.Image | None:
    """The image of a file beside the model; None, if it is none."""
    try:
        return Image.open(io.BytesIO(text.files.get(name)))
    except IMAGE_ERRORS:
        return None


def _why_lost(part: trimesh.Trimesh) -> str | None:
    """Why a part that should have a texture has none; None, if it has one."""
    image = material_image(part)
    if image is None and getattr(part.visual, "material", None) is not None:
        return "it is damaged, or no image of a kind that is known. Export it with PNG or JPEG images and UV coordinates"
    if image is None or not has_uv(part):
        return "its faces have no texture coordinates. Export it with UV coordinates"
    try:
        _decode(image)
    except UnreadableImageError as error:
        return f"{error}. Save the image as an 8-bit PNG or JPEG"
    return None

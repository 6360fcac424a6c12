"""How large a file may be that is taken for what it says it is: checked before anything of that size is allocated.

A damaged or hostile file may ask for any amount of memory in a few bytes. The limits here are far above what cameras, scanners
and people make, and far below what stops a machine. The settings group ``limits`` raises them, see :func:`limits`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from os import PathLike

from pydantic import BaseModel, ConfigDict, Field

from torchtrack.errors import LimitError

_MEGABYTE = 1 << 20


class Limits(BaseModel):
    """The largest that is read, of each kind. The default is many times what is usual."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sensor_pixels: int = Field(4096 * 2160, ge=1, description="Pixels of a sensor; the largest event cameras have 1280x720.")
    poses: int = Field(2_000_000, ge=1, description="Poses of one trajectory; three hours at 200 Hz.")
    mesh_bytes: int = Field(512 * _MEGABYTE, ge=1, description="Bytes of a model file.")
    faces: int = Field(2_000_000, ge=1, description="Triangles of a model; a tracker needs a few thousand.")
    vertices: int = Field(4_000_000, ge=1, description="Vertices of a model, or points of its lines.")
    scene_nodes: int = Field(10_000, ge=1, description="Nodes of a model's scene, such as the parts of a CAD assembly.")
    texture_pixels: int = Field(8192 * 8192, ge=1, description="Pixels of a texture, or of all textures of a model.")
    text_bytes: int = Field(2 * _MEGABYTE, ge=1, description="Bytes of a config or a calibration file.")
    text_nodes: int = Field(100_000, ge=1, description="Values in such a file, those that aliases (*name) repeat counted each time.")
    text_depth: int = Field(50, ge=1, le=200, description="Levels of lists and mappings within one another in such a file.")
    pose_file_bytes: int = Field(512 * _MEGABYTE, ge=1, description="Bytes of a file of poses.")
    array_bytes: int = Field(256 * _MEGABYTE, ge=1, description="Bytes of an array that is read whole, such as poses.")
    expansion: int = Field(2000, ge=1, description="How many times larger than its file what a file holds may be; zlib reaches 1000.")
    block_bytes: int = Field(
        256 * _MEGABYTE, ge=1, description="Bytes of a part of a recording that is read at once (packet, message, chunk), once decompressed."
    )


_active: ContextVar[Limits | None] = ContextVar("limits", default=None)


def current_limits() -> Limits:
    """The limits that hold here."""
    return _active.get() or Limits()


@contextmanager
def limits(chosen: Limits) -> Iterator[None]:
    """Within it, these limits hold for all that is read by this thread (or asyncio task)."""
    token = _active.set(chosen)
    try:
        yield
    finally:
        _active.reset(token)


def check_limit(name: str, value: int, where: str | PathLike[str]) -> None:
    """Refuse what is larger than the limit ``name``, a field of :class:`Limits`.

    Args:
        name: the limit.
        value: what the file asks for.
        where: the file, for the message.

    Raises:
        LimitError: if ``value`` is larger; the message names the limit and the setting that raises it.
    """
    limit: int = getattr(current_limits(), name)
    if value > limit:
        what = name.replace("_", " ")
        raise LimitError(
            f"'{where}' asks for {value:,} {what}, and the limit is {limit:,}: the file is damaged, or unusually large. "
            f"If it is right, raise the setting limits.{name} (on the command line: --limits.{name.replace('_', '-')} {value})."
        )

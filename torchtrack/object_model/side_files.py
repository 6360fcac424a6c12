"""Files that a model file names: material libraries, images, buffers.

People's tools write such names in many ways: with backslashes, with the folder of another computer, in quotes, with ``%20``
for a blank, in other capitals. Each is looked for as it is written first.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from trimesh.resolvers import Resolver

from torchtrack.core.limits import check_limit


class SideFiles(Resolver):
    """The files beside a model, by the names that it calls them; ``given`` are those that are held in memory."""

    def __init__(self, path: Path, given: dict[str, bytes] | None = None) -> None:
        """Files beside the model ``path``."""
        self.path = path
        self.given = given or {}

    def get(self, key: str) -> bytes:
        """The bytes of a file.

        Raises:
            FileNotFoundError: if it is not there.
            LimitError: if it is too large.
        """
        name = str(key)
        if name in self.given:
            return self.given[name]
        side_file = find_side_file(self.path, name)
        if side_file is None:
            raise FileNotFoundError(f"there is no file '{name}' in '{self.path.parent}'")
        check_limit("mesh_bytes", side_file.stat().st_size, side_file)
        return side_file.read_bytes()

    def write(self, name: str, data: Any) -> None:
        """Not for a model that is read."""
        raise NotImplementedError(f"'{name}' is not written: files beside a model are only read")

    def namespaced(self, namespace: str) -> "SideFiles":
        """The files of a folder below."""
        return SideFiles(self.path.parent / namespace / self.path.name)

    def keys(self) -> list[str]:
        """Names of what is held in memory."""
        return list(self.given)


def find_side_file(path: Path, name: str) -> Path | None:
    """The regular file that the model ``path`` calls ``name``; None if there is none."""
    for spelling in _spellings(name):
        try:
            candidate = path.parent / spelling
            if candidate.is_file():
                return candidate
            folder = candidate.parent
            alike = [entry for entry in folder.iterdir() if entry.name.lower() == candidate.name.lower()] if folder.is_dir() else []
        except (OSError, ValueError):  # a name that is too long for the system, or holds a NUL
            continue
        if alike and alike[0].is_file():
            return alike[0]
    return None


def _spellings(name: str) -> Iterator[str]:
    """The ways in which a file may be meant, the most literal first; at last its name without a folder, in the model's own."""
    name = name.strip()
    bare = name.strip("\"'")
    slashes = bare.replace("\\", "/")
    yield from dict.fromkeys([name, bare, unquote(bare), slashes, unquote(slashes), slashes.rsplit("/", 1)[-1]])


@dataclass(frozen=True)
class MeshText:
    """A mesh file, checked, as trimesh is to read it.

    Attributes:
        data: its bytes.
        kind: trimesh's name of the format.
        files: what it names.
        named: the files beside it that it names.
        images: the image that the material of each name should have; that of ``""`` is every part's.
    """

    data: bytes
    kind: str
    files: SideFiles
    named: tuple[str, ...] = ()
    images: dict[str, str] = field(default_factory=dict)

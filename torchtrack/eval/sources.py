"""Where the sequences of an evaluation come from: files, folders, and scenes that are simulated once and kept."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from torchtrack import __version__
from torchtrack.config.evaluate import CellConfig
from torchtrack.config.load import as_yaml, load
from torchtrack.errors import ConfigError, MissingFileError
from torchtrack.sim import SceneConfig, simulate, write

# Called with the name of a scene and how far it is simulated, 0 to 1.
Simulating = Callable[[str, float], None]


def find_sequences(paths: Sequence[Path]) -> list[Path]:
    """The ``.npz`` files that are named, or lie in the folders that are named, each once.

    Raises:
        ConfigError: if none is named.
        MissingFileError: if a path is not there, or a folder holds none.
    """
    if not paths:
        raise ConfigError("paths: nothing to evaluate. Name sequences (.npz), or folders of them.")
    found: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise MissingFileError(f"no sequence or folder at {path}. Check the path.")
        inside = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if not inside:
            raise MissingFileError(f"the folder {path} holds no sequence (.npz). Check the path.")
        found.update(dict.fromkeys(inside))
    return list(found)


def cell_sequence(cell: CellConfig, cache: Path, simulating: Simulating = lambda name, share: None) -> Path:
    """The sequence of one cell of the paper's tables; a scene is simulated where ``cache`` does not hold it yet.

    What was simulated is kept under the scene's name and a digest of all its settings, whole or not at all: an
    evaluation that was interrupted goes on where it was.

    Raises:
        MissingFileError: if the sequence or the scene's file is not there.
        ConfigError: if the scene's settings are wrong.
    """
    if cell.scene is None:
        return find_sequences([cell.source] if cell.source else [])[0]
    scene = load(SceneConfig, cell.scene, cell.overrides)
    digest = hashlib.sha256(f"{__version__}\n{as_yaml(scene)}".encode()).hexdigest()[:10]
    path = cache / f"{scene.name}-{digest}.npz"
    if not path.exists():
        simulating(scene.name, 0.0)
        cache.mkdir(parents=True, exist_ok=True)
        write(simulate(scene, lambda share: simulating(scene.name, share)), path)
    return path

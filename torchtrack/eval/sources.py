"""Where the sequences of an evaluation come from: files, folders, and scenes that are simulated once and kept."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchtrack.config.evaluate import CellConfig
from torchtrack.config.executor import ExecutorName
from torchtrack.config.load import load
from torchtrack.errors import ConfigError, MissingFileError
from torchtrack.eval.results import Failure
from torchtrack.io.sequence import is_sequence
from torchtrack.sim import SceneConfig
from torchtrack.sim.suite import Told, run_suite


def find_sequences(paths: Sequence[Path]) -> list[Path]:
    """The sequences (``.npz``, or ``.h5`` of ours) that are named, or lie in the folders that are named, each once.

    What else lies in a folder is passed over: recordings of events alone, and other HDF5 files.

    Raises:
        ConfigError: if none is named.
        MissingFileError: if a path is not there, or a folder holds none.
    """
    if not paths:
        raise ConfigError("paths: nothing to evaluate. Name sequences (.npz or .h5), or folders of them.")
    sequences: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise MissingFileError(f"no sequence or folder at {path}. Check the path.")
        inside = [path]
        if path.is_dir():
            inside = [file for file in sorted(path.iterdir()) if file.suffix == ".npz" or (file.suffix == ".h5" and is_sequence(file))]
        if not inside:
            raise MissingFileError(f"the folder {path} holds no sequence (.npz or .h5). Check the path.")
        sequences.update(dict.fromkeys(inside))
    return list(sequences)


def cell_sequences(
    cells: Mapping[str, CellConfig],
    cache: Path,
    jobs: int,
    simulating: Told = lambda name, share: None,
    executor: ExecutorName = "local",
) -> tuple[dict[str, Path], tuple[Failure, ...]]:
    """The sequence of each cell of the paper's tables, and which scenes failed; scenes that ``cache`` does not hold are simulated.

    What was simulated is kept with its settings, whole or not at all: an evaluation that was interrupted goes on where
    it was, and a scene whose settings have changed is simulated anew.

    Args:
        cells: by name.
        cache: folder of simulated sequences.
        jobs: processes that simulate.
        simulating: called with the name of a scene and how far it is simulated, 0 to 1.
        executor: where they are.

    Raises:
        MissingFileError: if a sequence or a scene's file is not there.
        ConfigError: if a scene's settings are wrong, or two different scenes have one name.
    """
    paths = {name: find_sequences([cell.source])[0] for name, cell in cells.items() if cell.source is not None}
    scenes: dict[str, SceneConfig] = {}
    for name, cell in cells.items():
        if cell.scene is None:
            continue
        scene = load(SceneConfig, cell.scene, cell.overrides)
        if scenes.setdefault(scene.name, scene) != scene:
            raise ConfigError(f"cells: two different scenes are called '{scene.name}'; each becomes a file of its name. Name one otherwise.")
        paths[name] = cache / f"{scene.name}.npz"
    if not scenes:
        return paths, ()
    failures = run_suite(list(scenes.values()), cache, jobs, simulating, executor=executor)
    return {name: paths[name] for name in cells}, tuple(Failure(failure.name, "simulation", failure.reason) for failure in failures)

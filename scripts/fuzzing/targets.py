"""What is done with a file of each kind: what a user would have done with it, as far as it takes a blink."""

from collections.abc import Callable
from pathlib import Path

import torch

from torchtrack.config.demo import DemoConfig
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.load import as_yaml, load
from torchtrack.config.run import RunConfig
from torchtrack.core.camera import undistortion_table
from torchtrack.core.files import naming
from torchtrack.eval.evaluate import plan
from torchtrack.io import is_sequence, open_events, read_calibration, read_sequence, read_trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.run.session import open_session
from torchtrack.sim.scenes import SceneConfig
from torchtrack.sim.suite import is_suite, scenes_of

SIZE = {"width": 64, "height": 48}
# Of a file that was damaged so that it holds very many events, the first are enough.
_MOST_EVENTS = 2_000_000


def _events(path: Path) -> None:
    sized = path.suffix in (".txt", ".zip")
    source = open_events(path, **SIZE) if sized else open_events(path)
    seen, last = 0, None
    for chunk in source.chunks():
        if int(chunk.x.max()) >= source.width or int(chunk.y.max()) >= source.height or int(chunk.x.min()) < 0 or int(chunk.y.min()) < 0:
            raise AssertionError("events outside the sensor")
        if not bool((chunk.t_us[1:] >= chunk.t_us[:-1]).all()) or (last is not None and int(chunk.t_us[0]) < last):
            raise AssertionError("events out of order")
        seen, last = seen + len(chunk), int(chunk.t_us[-1])
        if seen > _MOST_EVENTS:
            return
    next(iter(source.seek(5000).chunks()), None)
    source.info()
    if path.is_file():
        is_sequence(path)


def _sequence(path: Path) -> None:
    is_sequence(path)
    sequence = read_sequence(path)
    _events(path)
    for obj in sequence.objects:
        ObjectModel.from_file(obj.model_path(), name=obj.label)
        if obj.ground_truth is not None:
            obj.ground_truth.at(torch.tensor([0, 5000]))
    with naming(path):
        undistortion_table(sequence.camera)


def _calibration(path: Path) -> None:
    size = SIZE if path.suffix == ".txt" else {}
    with naming(path):
        undistortion_table(read_calibration(path, **size))


def _poses(path: Path) -> None:
    trajectory = read_trajectory(path, frame_us=1000 if path.suffix == ".json" else None)
    trajectory.at(trajectory.t_us[:1] + 500)


def _mesh(path: Path) -> None:
    ObjectModel.from_file(path, name="part")


def _lines(path: Path) -> None:
    ObjectModel.from_file(path, name="lines")


def _track(path: Path) -> None:
    config = load(RunConfig, path)
    as_yaml(config)
    with naming(path):
        open_session(config)


def _evaluate(path: Path) -> None:
    config = load(EvaluateConfig, path)
    as_yaml(config)
    # Cells may name scenes, and simulating one takes too long.
    if not config.cells:
        with naming(path):
            plan(config)


def _simulate(path: Path) -> None:
    scenes = scenes_of(path) if is_suite(path) else [load(SceneConfig, path)]
    for scene in scenes:
        as_yaml(scene)
        with naming(path):
            scene.camera.build()
            for obj in (*scene.objects, *scene.occluders):
                obj.build()


def _demo(path: Path) -> None:
    config = load(DemoConfig, path)
    as_yaml(config)
    load(SceneConfig, config.scene)


TARGETS: dict[str, Callable[[Path], None]] = {
    "events": _events,
    "sequence": _sequence,
    "calibration": _calibration,
    "poses": _poses,
    "mesh": _mesh,
    "lines": _lines,
    "track": _track,
    "evaluate": _evaluate,
    "simulate": _simulate,
    "demo": _demo,
}

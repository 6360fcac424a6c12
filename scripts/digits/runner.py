"""Track stored scenes with the torchtrack of one tree, and store every number of every window.

Run in a process of its own, with that tree first on the path::

    python runner.py INPUTS OUTPUTS RUNS.json TREE

``TREE`` is where torchtrack must come from. Whenever a run is stored, its number is written, a line of its own. Only public names of the
package are used; where they differ between two trees, :func:`make_tracker` is the one place for it.
"""

import json
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchtrack
from torchtrack.baselines import tracker_class


def make_tracker(models: list[Any], cameras: list[Any], streams: list[int], run: dict[str, Any]) -> Any:
    """The tracker that a run asks for."""
    config, dtype = torchtrack.preset(run["preset"]), getattr(torch, run["dtype"])
    return tracker_class(run["preset"])(models, cameras, config, streams, dtype, kernels=run["kernels"])


def numbers_of(value: Any, name: str = "") -> dict[str, torch.Tensor]:
    """All tensors and numbers of nested dataclasses, by dotted names."""
    if torch.is_tensor(value):
        return {name: value}
    if isinstance(value, bool | int | float):
        return {name: torch.tensor(value)}
    numbers = {}
    for field in fields(value) if is_dataclass(value) else ():
        numbers |= numbers_of(getattr(value, field.name), f"{name}.{field.name}" if name else field.name)
    return numbers


class Scene:
    """What is stored of a scene, as objects of the package."""

    def __init__(self, folder: Path, name: str) -> None:
        said, arrays = json.loads((folder / f"{name}.json").read_text()), np.load(folder / f"{name}.npz")
        self.streams: list[int] = said["streams"]
        self.cameras = [_camera(**camera) for camera in said["cameras"]]
        models = {model: torchtrack.ObjectModel.from_file(folder / f"{model}.glb") for model in set(said["models"])}
        self.models = [models[model] for model in said["models"]]
        self.T_start = torch.from_numpy(arrays["T_start"])
        self.arrays = {name: arrays[name] for name in arrays.files}

    def window(self, start_us: int, end_us: int) -> Any:
        """Events of all streams with ``start_us < t <= end_us``."""
        parts = []
        for stream in range(len(self.cameras)):
            t_us = self.arrays[f"t_us_{stream}"]
            first, last = np.searchsorted(t_us, [start_us, end_us], side="right")
            own = [self.arrays[f"{name}_{stream}"][first:last] for name in ("x", "y", "t_us", "polarity")]
            parts.append([*own, np.full(last - first, stream)])
        x, y, t_us, polarity, stream_index = (torch.from_numpy(np.concatenate(values)) for values in zip(*parts, strict=True))
        return torchtrack.EventBatch(x.int(), y.int(), t_us.long(), polarity > 0, stream_index.long())


def _camera(focal_px: float, width: int, height: int) -> Any:
    return torchtrack.Camera(fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height)


def results_of(scene: Scene, run: dict[str, Any]) -> list[Any]:
    """One result per window: of each step, or as ``track`` gives them, refined by what comes later."""
    tracker = make_tracker(scene.models, scene.cameras, scene.streams, run)
    with torch.inference_mode():
        state = tracker.init(scene.T_start, 0)
        ends_us = [run["window_us"] * (number + 1) for number in range(run["windows"])]
        windows = [scene.window(end_us - run["window_us"], end_us) for end_us in ends_us]
        if run["refined"]:
            return list(torchtrack.track(windows, tracker, state))
        results = []
        for events, end_us in zip(windows, ends_us, strict=True):
            state, result = tracker.step(state, events, end_us)
            results.append(result)
        return results


def main(inputs: Path, outputs: Path, runs: Path, tree: Path) -> None:
    """Take one run after the other."""
    home = Path(torchtrack.__file__).resolve().parents[1]
    if home != tree.resolve():
        raise SystemExit(f"torchtrack comes from {home}, not from {tree}: the comparison would be of something else.")
    torch.set_num_threads(1)
    scenes: dict[str, Scene] = {}
    for number, run in enumerate(json.loads(runs.read_text())):
        name = run["scene"]
        scenes[name] = scenes.get(name) or Scene(inputs, name)
        torch.save([numbers_of(result) for result in results_of(scenes[name], run)], outputs / f"{number}.pt")
        sys.stdout.write(f"{number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))

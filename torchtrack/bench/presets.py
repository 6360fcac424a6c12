"""What a step costs by presets with corners and flow, beside one of `default`: each window by one preset after the other.

Where one preset tracks a whole scene before the next one does, its data stays in the processor's caches, and the preset with the least gains most.
"""

import numpy as np
import torch

from torchtrack import Tracker
from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import Scene, read, simulated
from torchtrack.bench.setup import Setup
from torchtrack.config.presets import PresetName, preset

# Few plain faces, a smooth object, and one with print. A step of `default` is one of `causal`: what comes later refines its poses.
SHAPES = ("lbracket", "robot", "cube")
# The presets, and how many steps of `default` one may take.
MOST: dict[PresetName, float | None] = {"guided": 1.5, "nns": None, "paper": None}
DURATION_S = 0.3
# Windows before a tracker is in full motion.
WARM_UP = 8


def measure(setup: Setup) -> Report:
    """Time of a step by each preset, and how many times one of `default` that is.

    Raises:
        MissingExtraError: if scenes are to be simulated, and the simulator's libraries are not installed.
    """
    if setup.sequence is not None:
        scenes = {setup.sequence.stem: read(setup.sequence)}
    else:
        scenes = {shape: simulated((shape,), duration_s=DURATION_S) for shape in SHAPES}
    results: list[Result] = []
    for name, scene in scenes.items():
        setup.show(name)
        medians = np.array([_medians(setup, scene) for _ in range(setup.repeats)]).T.tolist()
        results += [time_result(f"{name}, {which}", seconds) for which, seconds in zip(("default", *MOST), medians, strict=True)]
        for (which, most), seconds in zip(MOST.items(), medians[1:], strict=True):
            ratios = tuple(ours / default for ours, default in zip(seconds, medians[0], strict=True))
            results.append(Result(f"{name}, {which} over default", "times", ratios, setup.cpu_target(most), lower_is_better=True))
    title = f"A step by each preset, in windows of 5 ms: median over windows, presets in turn; {setup.clock.meaning}"
    return Report("presets", title, tuple(results))


def _medians(setup: Setup, scene: Scene) -> list[float]:
    """Median time of a step (s) by `default`, then by the others."""
    trackers = [Tracker(scene.models, scene.camera, preset(name)).to(setup.device) for name in ("causal", *MOST)]
    states = [tracker.init(scene.T_cam_obj, scene.start_us) for tracker in trackers]
    seconds: list[list[float]] = [[] for _ in trackers]
    with torch.inference_mode():
        for events, end_us in scene.windows(trackers[0].config.window.duration_us):
            for number, tracker in enumerate(trackers):
                begun = setup.clock.now()
                states[number], _ = tracker.step(states[number], events.to(setup.device), end_us)
                seconds[number].append(setup.clock.now() - begun)
    return [float(np.median(of_one[WARM_UP:])) for of_one in seconds]

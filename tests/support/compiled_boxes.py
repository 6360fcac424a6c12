"""Tracks a box with and without compiled graphs, and prints how far the poses are apart: in a process of its own, without checks of types.

Arguments: the compiler's backend, how many windows, and the device.
"""

import json
import sys
from unittest import mock

import torch
from helpers import SMALL_CAMERA, box_model, pose
from tracked_boxes import follow, moving_box, windows

from torchtrack import Tracker
from torchtrack.config.tracker import AdaptationConfig, AssociationConfig, CornerConfig, TrackerConfig
from torchtrack.tracking import graphs

# What is compiled for each round of matching is the same: two are enough to see that they follow one another.
SMALL = TrackerConfig(
    adaptation=AdaptationConfig(learned_points=0), corners=CornerConfig(max_corners=0), association=AssociationConfig(gates_px=(5.0, 1.5))
)


class Counting(graphs.CompiledStep):
    """Graphs that say of each window whether they took it."""

    def __init__(self, tracker, *, compiles=True):
        super().__init__(tracker, compiles=compiles)
        self.took = []

    def __call__(self, state, events, t_us):
        done = super().__call__(state, events, t_us)
        self.took.append(done is not None)
        return done


def with_backend(backend):
    """``torch.compile`` with another backend, without the options of its own."""

    def compile_with(function, *, options, **how):
        options = {name: value for name, value in options.items() if backend == "inductor" or name == "guard_filter_fn"}
        return torch_compile(function, options=options, backend=backend, **how)

    torch_compile = torch.compile
    return mock.patch.object(torch, "compile", compile_with)


def main(backend, count, device):
    _, events = moving_box(pose(), count)
    config, cut = SMALL if backend == "inductor" else TrackerConfig(), windows(events, count)
    plain = Tracker([box_model()], SMALL_CAMERA, config)
    with torch.inference_mode():
        _, expected = follow(plain, plain.init(pose()[None], 0), cut)
    with with_backend(backend), mock.patch("torchtrack.tracking.tracker.CompiledStep", Counting), torch.inference_mode():
        tracker = Tracker([box_model()], SMALL_CAMERA, config, compiled=True).to(device)
        state = tracker.init(pose()[None], 0)
        tracker.prepare(state)
        prepared = len(tracker.graphs)
        _, results = follow(tracker, state, [(window.to(device), end_us) for window, end_us in cut])
    apart = max(float((ours.T_cam_obj.cpu() - other.T_cam_obj).abs().max()) for ours, other in zip(results, expected, strict=True))
    summary = {
        "apart": apart,
        "prepared": prepared,
        "graphs": len(tracker.graphs),
        "took": sum(tracker.graphs.took),
        "status": int(results[-1].status[0]),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])

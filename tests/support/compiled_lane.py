"""Prints what the compiled graph of a GPU gives, beside PyTorch's operations: on a CPU, with Triton's interpreter, in a process of its own.

Of types that are checked at runtime, a compiler would make a part of the graph.
"""

import json
import os

os.environ["TRITON_INTERPRET"] = "1"

from unittest import mock

import torch
from helpers import SMALL_CAMERA, box_model, pose
from tracked_boxes import follow, moving_box, windows

from torchtrack import Tracker
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.tracking import graphs

COUNT = 3
CONFIG = TrackerConfig.model_validate(
    {"association": {"max_events": 200}, "relocalization": {"new_below": 0}, "adaptation": {"learned_points": 0}, "disabled": ["window_parts"]}
)


class Called:
    """In the place of a CUDA graph: the function that it would record."""

    def __init__(self, function):
        self.function = function

    def __call__(self, *args):
        return self.function(*args)


def tracked(*, compiled):
    """Poses of two boxes that are tracked as on a GPU."""
    starts = torch.stack([pose(), pose(translation=(0.02, 0.0, 0.7))])
    _, events = moving_box(pose(), COUNT)
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA, CONFIG, compiled=compiled, kernels=compiled)
    with torch.inference_mode():
        results = follow(tracker, tracker.init(starts, 0), windows(events, COUNT))[1]
    return torch.stack([result.T_cam_obj for result in results]), len(tracker.graphs)


def main():
    operations, torch_compile = [], torch.compile

    def as_it_is(graph, inputs):
        operations.append(sorted(str(node.target) for node in graph.graph.nodes if "torchtrack." in str(node.target)))
        return graph.forward

    def compile_with(function, *, options, **how):
        return torch_compile(function, options={"guard_filter_fn": options["guard_filter_fn"]}, backend=as_it_is, **how)

    with (
        mock.patch.object(torch, "compile", compile_with),
        mock.patch.object(graphs, "CudaGraphs", Called),
        mock.patch.object(graphs.CompiledStep, "_near", lambda self, state, events, t_us: graphs.NearbyEvents(events)),
        mock.patch.object(dispatch, "_backend_for", lambda values: "cuda"),
        mock.patch.object(host_sync, "on_gpu", lambda values: True),
        mock.patch.object(host_sync, "read_at_once", lambda values: False),
    ):
        by_graph, count = tracked(compiled=True)
        plain, _ = tracked(compiled=False)
    print(json.dumps({"apart": float((by_graph - plain).abs().max()), "graphs": count, "operations": operations}))


if __name__ == "__main__":
    main()

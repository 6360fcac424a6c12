"""Graphs that are compiled: which versions can, and what becomes of those that PyTorch fails to compile. Their poses are in test_graphs.py."""

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose

from torchtrack import Tracker
from torchtrack.core.events import EventBatch
from torchtrack.errors import ConfigError, TorchtrackWarning
from torchtrack.tracking import compiling
from torchtrack.tracking.frontend.tiles import NearbyEvents


def test_an_old_version_of_pytorch_is_told(monkeypatch):
    monkeypatch.delattr(torch.compiler, "skip_all_guards_unsafe")
    with pytest.raises(ConfigError, match=r"compiled: PyTorch .* cannot compile a tracker. Update it"):
        Tracker([box_model()], SMALL_CAMERA, compiled=True)


def test_where_a_gpu_cannot_compile_windows_are_taken_as_they_are(monkeypatch):
    calls = []

    def failing(*args):
        calls.append(args)
        raise RuntimeError("a fault of the compiler")

    monkeypatch.setattr(compiling, "compiled", lambda function, device: failing)
    lane = compiling.compiled_or_as_it_is(lambda *args: ("taken", *args), torch.device("cuda"))
    state, t_us = Tracker([box_model()], SMALL_CAMERA).init(pose()[None], 0), torch.tensor([5000])
    given = state, NearbyEvents(EventBatch.empty()), t_us
    with pytest.warns(TorchtrackWarning, match="could not be compiled: a fault of the compiler.* not compiled"):
        assert lane(*given)[0] == "taken"
    assert lane(*given) == ("taken", *given)
    assert len(calls) == 1

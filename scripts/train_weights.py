#!/usr/bin/env python3
"""Train the network that says which observations to believe, from nothing: simulate its scenes, learn, write the weights.

    .venv/bin/python scripts/train_weights.py -o outputs/learned.safetensors

Scenes that were simulated before are taken as they are. With another folder of scenes, or your own sequences, it trains
for them; any setting of :class:`torchtrack.learn.training.TrainingConfig` can be given, such as ``--config.seed 1``.
"""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from torchtrack.core.atomic import atomic_path
from torchtrack.errors import TorchtrackError
from torchtrack.eval.sources import find_sequences
from torchtrack.learn.training import Trainer, TrainingConfig
from torchtrack.sim.suite import run_suite, scenes_of

SCENES = Path(__file__).resolve().parents[1] / "configs" / "simulate" / "learn" / "train.yaml"


@dataclass(frozen=True)
class Arguments:
    """Train the network that says how far each observation is to be believed."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/learned.safetensors")
    """Where the weights go."""
    scenes: Path = SCENES
    """Scenes to simulate and to train on."""
    simulated: Path = Path("outputs/learn_train")
    """Folder of the simulated sequences, kept."""
    sequences: tuple[Path, ...] = ()
    """Sequences to train on instead, or folders of them."""
    jobs: int = 2
    """Processes that simulate."""
    config: TrainingConfig = field(default_factory=TrainingConfig)
    """How it is trained."""


def main(arguments: Arguments) -> None:
    """Simulate where needed, train, write."""
    begun = time.perf_counter()

    def tell(line: str) -> None:
        sys.stdout.write(f"{time.perf_counter() - begun:5.0f} s  {line}\n")
        sys.stdout.flush()

    paths = list(arguments.sequences)
    if not paths:
        for failure in run_suite(scenes_of(arguments.scenes), arguments.simulated, arguments.jobs):
            sys.exit(f"error: scene {failure.name}: {failure.reason}")
        paths = [arguments.simulated]
        tell("simulated")
    network = Trainer(find_sequences(paths), arguments.config, tell).run()
    with atomic_path(arguments.output) as temporary:
        temporary.write_bytes(network.as_bytes())
    tell(f"the weights are in {arguments.output}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    try:
        main(tyro.cli(Arguments))
    except TorchtrackError as error:
        sys.exit(f"error: {error}")

"""Training of the network, small: both stages, and the script that does it all."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_sequence import write_tiny_sequence

from torchtrack.learn.augmentation import AugmentationConfig
from torchtrack.learn.dataset import ClipConfig
from torchtrack.learn.training import Trainer, TrainingConfig
from torchtrack.tracking.association.weighting_network import TrustNetwork

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "train_weights.py"
SMALL = TrainingConfig(
    clip=ClipConfig(windows=2, past_us=5_000),
    augmentation=AugmentationConfig(noise_hz=20.0, jitter_rotation_deg=0.2),
    batch_size=2,
    watched_epochs=1,
    fit_steps=200,
    fit_rows=256,
    tracked_epochs=1,
)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"))


def trainer(sequence, lines=None, **changes):
    return Trainer([sequence], SMALL.model_copy(update=changes), (lines if lines is not None else []).append)


@pytest.fixture(scope="module")
def gathered(sequence):
    return trainer(sequence).gather()


def test_observations_of_both_kinds_are_gathered(gathered):
    features, is_on = gathered
    assert len(features) == len(is_on) > 200 and torch.isfinite(features).all() and 0.2 < is_on.float().mean() < 0.95


def test_the_first_stage_learns_to_tell_them_apart(sequence, gathered):
    training = trainer(sequence)
    features, is_on = gathered
    training.fit(features, is_on)
    with torch.no_grad():
        logits = training.network.logits(features)
    assert logits[is_on].mean() > logits[~is_on].mean() + 1


def test_the_second_stage_moves_every_weight_by_finite_steps(sequence):
    lines = []
    training = trainer(sequence, lines, pose_share=1.0)
    before = {name: value.clone() for name, value in training.network.named_parameters()}
    training.train_through_tracker(0)
    for name, value in training.network.named_parameters():
        assert torch.isfinite(value).all() and not torch.equal(value, before[name]), name
    assert len(lines) == 1 and lines[0].startswith("epoch 1: labels ") and "px" in lines[0]


def test_the_same_seed_gives_the_same_weights(sequence):
    weights = [trainer(sequence, seed=seed, tracked_epochs=0, fit_steps=5).run().as_bytes() for seed in (0, 0, 1)]
    assert weights[0] == weights[1] != weights[2]


def test_the_script_writes_weights(sequence, tmp_path):
    options = {"clip.windows": 2, "clip.past-us": 5000, "batch-size": 2, "watched-epochs": 1, "fit-steps": 5, "tracked-epochs": 1}
    arguments = [text for name, value in options.items() for text in (f"--config.{name}", str(value))]
    command = [sys.executable, str(SCRIPT), "-o", str(tmp_path / "w.safetensors"), "--sequences", str(sequence), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "gathered" in done.stdout and "epoch 1" in done.stdout
    assert TrustNetwork.from_bytes((tmp_path / "w.safetensors").read_bytes()).layers[0].weight.isfinite().all()


def test_the_script_tells_what_is_wrong(tmp_path):
    command = [sys.executable, str(SCRIPT), "--sequences", str(tmp_path / "nowhere.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0 and "error: " in done.stderr and "nowhere.npz" in done.stderr and "Traceback" not in done.stderr

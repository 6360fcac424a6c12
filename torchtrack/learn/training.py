"""How the network that says which observations to believe is trained: by what observations are of, then through the tracker by its poses."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import DataLoader

from torchtrack.config.components import Component
from torchtrack.config.presets import preset
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.settings import Settings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.lie import difference_about
from torchtrack.learn.augmentation import AugmentationConfig
from torchtrack.learn.dataset import ClipConfig, SequenceBatches, WindowDataset
from torchtrack.learn.labels import true_distance
from torchtrack.learn.samples import Batch, collate, start_state, state_velocity
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.association.weighting_features import WeightingInputs, trust_features
from torchtrack.tracking.association.weighting_network import TrustNetwork
from torchtrack.tracking.tracker import Tracker

# The velocity a sample starts with is uncertain by this: as it is in the middle of a motion (m/s).
_SPEED_SIGMA_M_S = 0.1


class TrainingConfig(Settings):
    """How the weights are trained."""

    clip: ClipConfig = ClipConfig(windows=8, past_us=30_000)
    augmentation: AugmentationConfig = AugmentationConfig(
        flip_polarity=0.5, drop_events=0.3, noise_hz=2.0, stretch_time=(0.7, 1.4), jitter_rotation_deg=0.6, jitter_translation_m=0.001
    )
    batch_size: int = Field(4, ge=1, description="Samples of a batch, all of one object.")
    on_px: float = Field(1.0, gt=0, description="Observations nearer to the true contour are of it (px).")
    off_px: float = Field(2.0, gt=0, description="Observations further from it are not; those between are not asked about (px).")
    watched_epochs: int = Field(1, ge=1, description="Passes over all samples that observations are gathered in.")
    kept: int = Field(200, ge=1, description="Observations of each window that are kept from these.")
    fit_steps: int = Field(1500, ge=1, description="Steps of the first stage, on the observations gathered.")
    fit_rows: int = Field(2048, ge=1, description="Observations of one such step.")
    fit_rate: float = Field(4e-3, gt=0, description="Largest rate of learning in the first stage.")
    tracked_epochs: int = Field(2, ge=0, description="Passes over all samples of the second stage, through the tracker.")
    tracked_rate: float = Field(1e-3, gt=0, description="Largest rate of learning in the second stage.")
    pose_share: float = Field(0.5, ge=0, le=1, description="Share of the poses in the second stage's loss; the rest is that of the first stage.")
    seed: int = Field(0, ge=0, description="Of weights, order and variations.")


@dataclass(frozen=True)
class Seen:
    """One window of a sample: what the network saw and said, and where the tracker's poses are wrong.

    Args:
        logits, features: of each observation.
        is_on: which are of the true contour, where ``known``.
        error_px: how far the poses are off, as a way of the object's rim and centre in the image.
    """

    logits: Float[Tensor, "b n"]
    features: Float[Tensor, "b n f"]
    is_on: Bool[Tensor, "b n"]
    known: Bool[Tensor, "b n"]
    error_px: Float[Tensor, "b"]

    def loss_of_labels(self) -> Tensor:
        """How wrong the network is about observations."""
        return binary_cross_entropy_with_logits(self.logits[self.known], self.is_on[self.known].to(self.logits.dtype))


class _Watched(nn.Module):
    """A network that remembers what it saw last; without trust in it, every observation is believed."""

    def __init__(self, network: TrustNetwork) -> None:
        super().__init__()
        self.network, self.believed = network, True

    def forward(self, inputs: WeightingInputs) -> Tensor:
        self.inputs, self.features = inputs, trust_features(inputs)
        self.logits = self.network.logits(self.features)
        return torch.sigmoid(self.logits) if self.believed else torch.ones_like(self.logits)


class Trainer:
    """Trains a network on sequences with truth.

    Args:
        sources: sequence files.
        config: how.
        tell: called with what was reached, line by line.

    Raises:
        TorchtrackError: of the kind that fits, if a sequence is missing or wrong.
    """

    def __init__(self, sources: list[Path], config: TrainingConfig, tell: Callable[[str], None]) -> None:
        self.config, self.tell = config, tell
        torch.manual_seed(config.seed)
        self.watched = _Watched(TrustNetwork())
        self.dataset = WindowDataset(sources, config.clip, config.augmentation, seed=config.seed)
        self.batches = SequenceBatches(self.dataset, config.batch_size, config.seed)
        self._tracker = cache(self._new_tracker)

    @property
    def network(self) -> TrustNetwork:
        """The network, as it is now."""
        return self.watched.network

    def run(self) -> TrustNetwork:
        """Both stages, one after the other."""
        self.fit(*self.gather())
        for epoch in range(self.config.tracked_epochs):
            self.train_through_tracker(epoch)
        return self.network

    def gather(self) -> tuple[Tensor, Tensor]:
        """Features of observations ``[r, f]``, and which are of the contour ``[r]``, as the tracker meets them without the network."""
        rows: list[tuple[Tensor, Tensor]] = []
        self.watched.believed = False
        with torch.no_grad():
            for epoch in range(self.config.watched_epochs):
                for seen in self.windows(epoch):
                    for features, is_on, known in zip(seen.features, seen.is_on, seen.known, strict=True):
                        chosen = known.nonzero()[:, 0]
                        chosen = chosen[torch.randperm(len(chosen))[: self.config.kept]]
                        rows.append((features[chosen], is_on[chosen]))
                self.tell(f"gathered {sum(len(row[1]) for row in rows)} observations")
        self.watched.believed = True
        features, is_on = (torch.cat(column) for column in zip(*rows, strict=True))
        return features, is_on

    def fit(self, features: Float[Tensor, "r f"], is_on: Bool[Tensor, "r"]) -> None:
        """The first stage: tell observations of the contour from others."""
        config = self.config
        optimiser = torch.optim.AdamW(self.network.parameters(), weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.fit_rate, config.fit_steps)
        for step in range(config.fit_steps):
            row = torch.randint(len(features), (config.fit_rows,))
            loss = binary_cross_entropy_with_logits(self.network.logits(features[row]), is_on[row].to(features.dtype))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            if step % 500 == 499:
                self.tell(f"step {step + 1}: loss {loss.item():.4f}")

    def train_through_tracker(self, epoch: int) -> None:
        """One pass of the second stage: lower the errors of the poses, whose gradients come through the tracker."""
        config = self.config
        optimiser = torch.optim.AdamW(self.network.parameters(), config.tracked_rate * 0.5**epoch, weight_decay=1e-3)
        labels, errors, losses = [], [], []
        for count, seen in enumerate(self.windows(config.watched_epochs + epoch), start=1):
            loss = config.pose_share * seen.error_px.log1p().mean() + (1 - config.pose_share) * seen.loss_of_labels()
            losses.append(loss)
            labels.append(seen.loss_of_labels().detach())
            errors.append(seen.error_px.detach())
            if count % config.clip.windows == 0:
                optimiser.zero_grad()
                torch.stack(losses).mean().backward()
                nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
                optimiser.step()
                losses.clear()
        error_px = torch.cat(errors)
        self.tell(f"epoch {epoch + 1}: labels {torch.stack(labels).mean():.4f}, error {error_px.mean():.3f} px, median {error_px.median():.3f} px")

    def windows(self, epoch: int) -> Iterator[Seen]:
        """All windows of all batches of an epoch, as the tracker meets them."""
        self.dataset.set_epoch(epoch)
        for batch in DataLoader(self.dataset, batch_sampler=self.batches, collate_fn=collate):
            yield from self._track(batch)

    def _track(self, batch: Batch) -> Iterator[Seen]:
        """The windows of one batch."""
        tracker = self._tracker(int(batch.sequence[0]), int(batch.object[0]))
        state = start_state(tracker, batch, _SPEED_SIGMA_M_S)
        centre_obj = tracker.centre_obj.double()
        for number in range(batch.windows):
            events, t_end_us = batch.window(number)
            state, _ = tracker(events, state, t_end_us)
            T_true = batch.T_cam_obj[:, number + 1]
            velocity = state_velocity(batch.velocity[:, number + 1], T_true, centre_obj)
            with torch.no_grad():
                distance = true_distance(tracker, self.watched.inputs, T_true, velocity)
            is_on = distance < self.config.on_px
            known = (is_on | (distance > self.config.off_px)) & self.watched.inputs.observations.mask
            error_px = _error_px(tracker, state.T_cam_obj, T_true)
            yield Seen(self.watched.logits, self.watched.features, is_on, known, error_px.to(self.watched.logits.dtype))

    def _new_tracker(self, sequence: int, number: int) -> Tracker:
        """The tracker of a batch of one object, without what only a lost object needs."""
        source, count = self.dataset.sequences[sequence], self.config.batch_size
        model = ObjectModel.from_file(source.objects[number].model_path())
        config = tracker_config(preset("default"))
        return Tracker([model] * count, [source.camera] * count, config, stream_index=range(count), weighting_network=self.watched)


def tracker_config(config: TrackerConfig) -> TrackerConfig:
    """Settings for training: without search, and without windows in parts."""
    return config.model_copy(update={"relocalization": RelocalizationConfig(hypotheses=0), "disabled": config.disabled | {Component.WINDOW_PARTS}})


def _error_px(tracker: Tracker, T_cam_obj: Float[Tensor, "b 4 4"], T_true: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b"]:
    """How far poses are off: the ways of the rim by the rotation and of the centre, as seen at the object's depth (px)."""
    centre_obj, diameter_m = tracker.centre_obj.double(), tracker.diameter_m.double()
    off = difference_about(T_true, T_cam_obj, centre_obj)
    way_m = torch.cat([off[:, :3] * (0.5 * diameter_m[:, None]), off[:, 3:]], -1)
    depth_m = (T_true[:, :3, :3] @ centre_obj[..., None])[:, 2, 0] + T_true[:, 2, 3]
    # The root of a sum that is never zero, where it has no slope.
    return (way_m.square().sum(-1) + 1e-12).sqrt() * tracker.intrinsics[:, 0].double() / depth_m

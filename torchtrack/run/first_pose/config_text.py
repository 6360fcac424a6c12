"""A config of ``torchtrack track`` with a pose that was found: everything that was said to find it, and the pose."""

import os
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import yaml

from torchtrack.config.presets import preset
from torchtrack.config.run import PoseConfig, RunConfig
from torchtrack.run.first_pose.tracked import FirstPose

# What is said of a run elsewhere, or anew in each.
_LEFT_OUT = {"limits", "output", "objects"}


def as_config(config: RunConfig, label: str, pose: FirstPose, folder: Path) -> str:
    """The text of a config that starts at the pose.

    Args:
        config: what the pose was found with.
        label: of the object that it is of.
        pose: the pose.
        folder: of the config: files in it, and below, are named relative to it.
    """
    initial_pose = PoseConfig(matrix=tuple(tuple(row) for row in pose.T_cam_obj.tolist()))
    objects = [obj.model_copy(update={"initial_pose": initial_pose}) if obj.label == label else obj for obj in config.objects]
    # What a preset says, its name says.
    of_preset = {"tracker"} if config.tracker == preset(config.preset) else set()
    said = {
        **config.model_dump(exclude_defaults=True, exclude=_LEFT_OUT | of_preset),
        "start_us": pose.at_us,
        "output": folder / "outputs" / label,
        "objects": [obj.model_dump(exclude_defaults=True) for obj in objects],
    }
    return yaml.safe_dump(_plain(said, folder), sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)


def _plain(value: Any, folder: Path) -> Any:
    """The same nested value of what YAML knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner, folder) for key, inner in value.items()}
    if isinstance(value, list | tuple | frozenset):
        return [_plain(inner, folder) for inner in (sorted(value) if isinstance(value, frozenset) else value)]
    if isinstance(value, Enum):
        return str(value)
    if isinstance(value, Path):
        return os.fspath(value.relative_to(folder) if value.is_relative_to(folder) else value)
    return value

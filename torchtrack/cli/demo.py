"""``torchtrack demo``: a scene simulated, tracked, and shown."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchtrack.cli.simulate import simulated_to
from torchtrack.cli.track import run_and_show
from torchtrack.config.demo import DemoConfig
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.files import naming
from torchtrack.sim import SceneConfig


def demo(config_file: Path | None, overrides: Mapping[str, Any], *, quiet: bool) -> int:
    """Simulate a scene, track it, show the errors; returns the exit code."""
    config = load(DemoConfig, config_file, overrides)
    scene = load(SceneConfig, config.scene)
    with naming(config.scene):
        sequence = simulated_to(scene, config.output / f"{scene.name}.npz", quiet)
    shared = {name: getattr(config, name) for name in DemoConfig.model_fields if name in RunConfig.model_fields}
    return run_and_show(RunConfig(source=sequence, **shared), quiet)

"""Settings of the demonstration: a scene to simulate, and how it is tracked."""

from importlib.resources import files
from pathlib import Path

from pydantic import Field

from torchtrack.config.run import Models, OverlayConfig, TrackingConfig
from torchtrack.config.settings import ConfigPath
from torchtrack.core.limits import Limits, current_limits


def _own_scene() -> Path:
    """The scene that comes with the package: an installed one has no folder of configs."""
    return Path(str(files("torchtrack") / "scenes" / "demo.yaml"))


class DemoConfig(TrackingConfig):
    """Settings of ``torchtrack demo``."""

    scene: ConfigPath = Field(
        default_factory=_own_scene, description="YAML file of the scene to simulate, as for `torchtrack simulate`; the package's own when not given."
    )
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "demo", description="Folder for the results; by default in the working folder."
    )
    models: Models = Field("textured", description="Track textured models where the scene has them, or geometry alone.")
    threads: int = Field(1, ge=1, le=256, description="Threads of the tracker on the CPU.")
    overlay: OverlayConfig = OverlayConfig()
    limits: Limits = Field(default_factory=current_limits, description="How large files may be.")

"""Settings of the demonstration: a scene to simulate, and how it is tracked."""

from pathlib import Path

from pydantic import Field

from torchtrack.config.run import Models, OverlayConfig, TrackingConfig
from torchtrack.config.settings import ConfigPath
from torchtrack.core.limits import Limits, current_limits


class DemoConfig(TrackingConfig):
    """Settings of ``torchtrack demo``."""

    scene: ConfigPath = Field(description="YAML file of the scene to simulate, as for `torchtrack simulate`.")
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "demo", description="Folder for the results; by default in the working folder."
    )
    models: Models = Field("textured", description="Track textured models where the scene has them, or geometry alone.")
    threads: int = Field(1, ge=1, le=256, description="Threads of the tracker on the CPU.")
    overlay: OverlayConfig = OverlayConfig()
    limits: Limits = Field(default_factory=current_limits, description="How large files may be.")

"""Settings of an evaluation: which sequences, and which methods are compared on them."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints

from torchtrack.config.run import Models, TrackingConfig
from torchtrack.config.settings import ConfigPath, Settings

Label = Annotated[str, StringConstraints(pattern=r"^[\w-]+$")]


class MethodConfig(TrackingConfig):
    """One column of the comparison: a preset and what differs from it."""


class EvaluateConfig(Settings):
    """Settings of ``torchtrack evaluate``."""

    paths: tuple[ConfigPath, ...] = Field((), description="Sequences, or folders of sequences.")
    methods: dict[Label, MethodConfig] = Field({"default": MethodConfig()}, min_length=1, description="Label of each method and its settings.")
    models: Models = Field("textured", description="Use textured models where a sequence has them, or geometry alone.")
    jobs: int = Field(2, ge=1, le=1024, description="Processes, of one thread each.")
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "evaluate", description="Folder for the results; by default in the working folder."
    )
    lost_rotation_deg: float = Field(10.0, gt=0, le=180, description="A window with a larger rotation error counts as lost (°).")
    lost_translation_cm: float = Field(5.0, gt=0, description="A window with a larger translation error counts as lost (cm).")

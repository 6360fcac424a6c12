"""Settings of an evaluation: which sequences, which methods are compared on them, and how the results are laid out."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, model_validator

from torchtrack.config.executor import ExecutorName
from torchtrack.config.run import Models, TrackingConfig
from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core.limits import Limits, current_limits

Label = Annotated[str, StringConstraints(pattern=r"^[\w-]+$")]
CellName = Annotated[str, StringConstraints(pattern=r"^\d\d( [a-z]+)?$")]
Report = Literal["sequences", "compact", "paper"]


class MethodConfig(TrackingConfig):
    """One column of the comparison: a preset and what differs from it."""


class CellConfig(Settings):
    """The sequence that is measured for one cell of the paper's tables."""

    source: ConfigPath | None = Field(None, description="A sequence (.npz).")
    scene: ConfigPath | None = Field(None, description="Instead, a scene to simulate once into the folder 'cache'.")
    overrides: dict[str, Any] = Field({}, description="Settings of the scene, by dotted key, that differ from its file.")
    object: str | None = Field(None, min_length=1, description="Label of the object that counts; by default the first.")

    @model_validator(mode="after")
    def _one_way(self) -> "CellConfig":
        if (self.source is None) == (self.scene is None):
            raise ValueError("give exactly one of source and scene")
        if self.overrides and self.scene is None:
            raise ValueError("overrides are for a scene; a source is taken as it is")
        return self


class EvaluateConfig(Settings):
    """Settings of ``torchtrack evaluate``."""

    paths: tuple[ConfigPath, ...] = Field((), description="Sequences, or folders of sequences.")
    methods: dict[Label, MethodConfig] = Field({"default": MethodConfig()}, min_length=1, description="Label of each method and its settings.")
    models: Models = Field("textured", description="Use textured models where a sequence has them, or geometry alone.")
    jobs: int = Field(2, ge=1, le=1024, description="Processes, of one thread each.")
    executor: ExecutorName = Field("local", description="Processes of this machine, or Ray's: of the cluster at RAY_ADDRESS, else of this machine.")
    streams: int = Field(1, ge=1, le=1024, description="Sequences that a process tracks at once, as one batch.")
    report: Report = Field(
        "sequences", description="Layout: a row per sequence, object and method; a compact row per method; or the tables of the paper."
    )
    cells: dict[CellName, CellConfig] = Field({}, description="Sequence of each cell of the paper's tables, by its name, such as '01 slow' or '13'.")
    cache: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "simulated",
        description="Folder of simulated scenes, kept; by default in the working folder.",
    )
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "evaluate", description="Folder for the results; by default in the working folder."
    )
    resume: bool = Field(False, description="Take up an evaluation that was broken off: what is measured already is not measured again.")
    limits: Limits = Field(default_factory=current_limits, description="How large files may be.")
    lost_rotation_deg: float = Field(10.0, gt=0, le=180, description="A window with a larger rotation error counts as lost (°).")
    lost_translation_cm: float = Field(5.0, gt=0, description="A window with a larger translation error counts as lost (cm).")

    @model_validator(mode="after")
    def _cells_for_the_paper(self) -> "EvaluateConfig":
        if bool(self.cells) != (self.report == "paper"):
            raise ValueError("cells and report: paper belong together: the cells say which sequence is measured for each cell of the paper's tables")
        return self

"""Settings of an evaluation: which sequences, which methods are compared on them, and how the results are laid out."""

from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, model_validator

from torchtrack.config.executor import ExecutorName
from torchtrack.config.merge import merged
from torchtrack.config.run import Models, TrackingConfig
from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core.limits import Limits, current_limits

Label = Annotated[str, StringConstraints(pattern=r"^[\w-]+$")]
CellName = Annotated[str, StringConstraints(pattern=r"^\d\d( [a-z]+)?$")]
Report = Literal["sequences", "compact", "trial", "paper"]


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
    methods: dict[Label, MethodConfig] = Field(
        {"default": MethodConfig()}, min_length=1, description="Label of each method and its settings; 'joins' lists methods whose settings it joins."
    )
    runs: int = Field(1, ge=1, le=100, description="Runs of each method in a trial, which differ by roundings alone.")
    start_angles_deg: dict[str, Annotated[float, Field(ge=0, le=180)]] = Field(
        {}, description="By pattern of a sequence's name (* is any text): the initial poses of its objects are turned by this angle (°)."
    )
    models: Models = Field("textured", description="Use textured models where a sequence has them, or geometry alone.")
    jobs: int = Field(2, ge=1, le=1024, description="Processes, of one thread each.")
    executor: ExecutorName = Field("local", description="Processes of this machine, or Ray's: of the cluster at RAY_ADDRESS, else of this machine.")
    streams: int = Field(1, ge=1, le=1024, description="Sequences that a process tracks at once, as one batch.")
    report: Report = Field(
        "sequences",
        description="Layout: a row per sequence, object and method; a row per method; what is left out by each method; or the paper's tables.",
    )
    table: ConfigPath | None = Field(None, description="Markdown file that gets the table of a trial, between <!-- TRIAL --> and <!-- /TRIAL -->.")
    cells: dict[CellName, CellConfig] = Field({}, description="Sequence of each cell of the paper's tables, by its name, such as '01 slow' or '13'.")
    cache: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "simulated",
        description="Folder of simulated scenes, kept; by default in the working folder.",
    )
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "evaluate", description="Folder for the results; by default in the working folder."
    )
    resume: bool = Field(False, description="Take up an evaluation that was broken off: what is measured already is not measured again.")
    measured_only: bool = Field(False, description="Measure nothing: report what an evaluation that was broken off, or still runs, has measured.")
    limits: Limits = Field(default_factory=current_limits, description="How large files may be.")
    lost_rotation_deg: float = Field(10.0, gt=0, le=180, description="A window with a larger rotation error counts as lost (°).")
    lost_translation_cm: float = Field(5.0, gt=0, description="A window with a larger translation error counts as lost (cm).")

    @model_validator(mode="before")
    @classmethod
    def _joined_methods(cls, values: Any) -> Any:
        """Give each method that joins others their settings, in the order of their names, and its own on top."""
        methods = values.get("methods") if isinstance(values, dict) else None
        if not isinstance(methods, dict):
            return values
        return {**values, "methods": {label: _joined(label, methods, ()) for label in methods}}

    @model_validator(mode="after")
    def _of_a_trial(self) -> "EvaluateConfig":
        if self.report != "trial" and (self.runs > 1 or self.table is not None):
            raise ValueError("runs and table are of report: trial, which compares what runs have in common; set it, or leave them out")
        return self

    @model_validator(mode="after")
    def _cells_for_the_paper(self) -> "EvaluateConfig":
        if bool(self.cells) != (self.report == "paper"):
            raise ValueError("cells and report: paper belong together: the cells say which sequence is measured for each cell of the paper's tables")
        return self


def _joined(label: str, methods: Mapping[str, Any], within: tuple[str, ...]) -> Any:
    """The settings of a method, with those of the methods that it joins beneath."""
    method = methods[label]
    if not isinstance(method, dict) or "joins" not in method:
        return method
    members, own = method["joins"], {key: value for key, value in method.items() if key != "joins"}
    if not isinstance(members, list) or not members:
        raise ValueError(f"methods.{label}.joins: give a list of labels of methods; got {members!r}")
    if unknown := [str(member) for member in members if member not in methods or member in (label, *within)]:
        raise ValueError(f"methods.{label}.joins: {', '.join(unknown)} is no other method; there are {', '.join(methods)}")
    joined = [*(_joined(member, methods, (label, *within)) for member in members), own]
    disabled = sorted({str(name) for each in joined for name in _disabled(each)})
    return merged(reduce(merged, joined), {"tracker": {"disabled": disabled}} if disabled else {})


def _disabled(method: Any) -> list[Any]:
    """The components that a method leaves out; none where that is not said as it should be, which its own check tells."""
    tracker = method.get("tracker") if isinstance(method, dict) else None
    disabled = tracker.get("disabled") if isinstance(tracker, dict) else None
    return disabled if isinstance(disabled, list) else []

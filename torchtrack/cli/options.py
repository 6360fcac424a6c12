"""The options of each command. What a command does is imported when it runs: ``torchtrack --help`` is not to wait for PyTorch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from torchtrack.cli.console import starting
from torchtrack.cli.option import option
from torchtrack.cli.options_files import refuse_settings
from torchtrack.config.executor import ExecutorName
from torchtrack.config.settings import CommandLineText
from torchtrack.errors import ConfigError

_Output = Annotated[str | None, option("DIR", "-o")]


_Preset = Annotated[str | None, option("NAME")]


_Models = Annotated[Literal["textured", "geometry"] | None, option("textured|geometry")]


_Number = Annotated[int | None, option("N")]


_Executor = Annotated[ExecutorName | None, option("local|ray")]


# Options that say how several sources are shared out.
_OF_MANY = ("streams", "jobs", "executor")


@dataclass(frozen=True)
class Track:
    """Track the objects of recordings or sequences; write poses, overlay and summary of each."""

    configs: Positional[Annotated[tuple[str, ...], arg(metavar="CONFIG|SOURCE ...")]]
    """YAML config files, or directly sequences (.npz)."""
    output: _Output = None
    """Folder for the results; of several sources, with a folder for each, of its name."""
    preset: _Preset = None
    """Method to track with: default, paper, line, ls or nns."""
    models: _Models = None
    """Use a sequence's textured models where it has them, or geometry alone."""
    start_us: _Number = None
    """Time of the initial pose, in stream time (µs)."""
    end_us: _Number = None
    """Tracking ends here, in stream time (µs)."""
    device: Annotated[str | None, option("NAME")] = None
    """Where the tracker runs: cpu, cuda or cuda:N."""
    threads: _Number = None
    """Threads of the tracker on the CPU."""
    streams: _Number = None
    """Of several sources, so many are tracked at once, as one batch."""
    jobs: Annotated[int | None, option("N", "-j")] = None
    """Processes for several sources."""
    executor: _Executor = None
    """Where these are: on this machine, or Ray's (the cluster at RAY_ADDRESS)."""
    compiled: bool = False
    """Compile the tracker: a step takes half the time, the first start some minutes."""
    resume: bool = False
    """Go on with a run in the same folder that ended early, from its last pose; of several, leave out those that are complete."""
    poses: Annotated[str | None, option("-|FILE")] = None
    """Also write a line of JSON per window and object as soon as it is tracked; to - (standard output, which has nothing else then)."""
    rerun: Annotated[str | None, option("FILE|live")] = None
    """Show all of it in the Rerun viewer: live, or later from a file (.rrd)."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.track import ExtraOutputs, track, track_many

        if not self.configs:
            raise ConfigError("command line: track needs a config file or a source.")
        given = _given(self, ("configs", "quiet", "resume", "poses", "rerun", *_OF_MANY)) | overrides
        of_many = {name: getattr(self, name) for name in _OF_MANY if getattr(self, name) is not None}
        if len(self.configs) > 1:
            if of_one := [name for name in ("poses", "rerun") if getattr(self, name) is not None]:
                raise ConfigError(f"command line: {', '.join(of_one)}: only for one source, and several are given.")
            return track_many(self.configs, given, **of_many, resume=self.resume, quiet=self.quiet)
        if of_many:
            raise ConfigError(f"command line: {', '.join(of_many)}: only for several sources, and one is given.")
        return track(self.configs[0], given, ExtraOutputs(self.poses, self.rerun), resume=self.resume, quiet=self.quiet)


@dataclass(frozen=True)
class Evaluate:
    """Track sequences with known ground truth under one or more methods and compare the errors."""

    paths: Positional[Annotated[tuple[str, ...], option("[PATH ...]")]] = ()
    """Sequences (.npz), or folders of them."""
    output: _Output = None
    """Folder for metrics.json, errors.csv and the report's tables."""
    methods: Annotated[str | None, option("A,B,...")] = None
    """Comma-separated: labels of methods in the config file, or presets: default, paper, line, ls, nns."""
    config: Annotated[str | None, option("FILE")] = None
    """A YAML config file with paths and methods."""
    models: _Models = None
    """Use a sequence's textured models where it has them, or geometry alone."""
    jobs: Annotated[int | None, option("N", "-j")] = None
    """Processes, of one thread each."""
    executor: _Executor = None
    """Where these are: on this machine, or Ray's (the cluster at RAY_ADDRESS)."""
    streams: _Number = None
    """Sequences that each tracks at once, as one batch."""
    report: Annotated[Literal["sequences", "compact", "trial"] | None, option("sequences|compact|trial")] = None
    """A row per sequence, object and method; one per method; or what each method's left out components are worth."""
    runs: _Number = None
    """Of a trial: runs of each method, which differ by roundings alone."""
    table: Annotated[str | None, option("FILE")] = None
    """Of a trial: a Markdown file that gets its table, between <!-- TRIAL --> and <!-- /TRIAL -->."""
    resume: bool = False
    """Take up an evaluation into the same folder that was broken off: what it measured with the same settings is kept."""
    measured_only: bool = False
    """Measure nothing: report what an evaluation into the same folder has measured that was broken off, or still runs."""
    estimate_latency: bool = False
    """Track nothing; find how late the events of each sequence are against its ground truth."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.evaluate import evaluate, show_latency

        if self.estimate_latency:
            refuse_settings(overrides)
            if useless := [name for name in _OF_MANY if getattr(self, name) is not None]:
                raise ConfigError(f"command line: {', '.join(useless)}: not with --estimate-latency, which takes one sequence after the other.")
            return show_latency(self.paths)
        chosen = self.methods.split(",") if self.methods else None
        given = _given(self, ("config", "methods", "quiet", "paths", "estimate_latency"))
        if self.paths:
            given["paths"] = [CommandLineText(path) for path in self.paths]
        return evaluate(self.config, given, overrides, chosen, quiet=self.quiet)


@dataclass(frozen=True)
class Simulate:
    """Simulate an event camera before moving objects, or make events of a video; write sequences with their ground truth."""

    config: Positional[Annotated[str, option("[CONFIG]")]] = ""
    """A YAML file of a scene or a suite, or a folder of them."""
    output: Annotated[str, option("FILE|DIR", "-o")] = ""
    """The sequence to write (.npz with its meshes beside it, or .h5 with all in one); of a suite, the folder."""
    variant: Annotated[str | None, option("NAME")] = None
    """One variant of a scene that has several; all of them when not given."""
    jobs: Annotated[int, arg(aliases=["-j"], metavar="N")] = 2
    """Processes of a suite, of one thread each."""
    executor: Annotated[ExecutorName, arg(metavar="local|ray")] = "local"
    """Where these are: on this machine, or Ray's (the cluster at RAY_ADDRESS)."""
    preview: bool = False
    """Also write a video of each scene, with events and true contours."""
    video: Annotated[str | None, option("FILE|DIR")] = None
    """In place of a scene: a video, or a folder of images."""
    frames_per_second: Annotated[float | None, option("N", "--fps")] = None
    """Of the video, where it does not say it."""
    timestamps: Annotated[str | None, option("FILE")] = None
    """Times of the video's frames (s), one a line."""
    noise: Annotated[Literal["ideal", "default", "realistic"] | None, option("NAME")] = None
    """Event camera profile."""
    quiet: bool = False
    """No progress bar."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.simulate import simulate, simulate_video

        if not self.output:
            raise ConfigError("command line: simulate needs an output, as in -o sequence.npz.")
        if bool(self.config) == bool(self.video):
            raise ConfigError("command line: simulate needs either the file of a scene or --video, and not both.")
        given = _given(self, ("config", "output", "jobs", "executor", "preview", "quiet"))
        if self.video:
            if self.executor != "local":
                raise ConfigError("command line: executor is for several scenes, not for --video.")
            return simulate_video(given, self.output, overrides, quiet=self.quiet)
        scene_only = {name: value for name, value in given.items() if name in ("variant", "noise")}
        if len(scene_only) != len(given):
            raise ConfigError("command line: frames_per_second and timestamps are for --video.")
        return simulate(
            self.config, self.output, scene_only | overrides, jobs=self.jobs, executor=self.executor, preview=self.preview, quiet=self.quiet
        )


@dataclass(frozen=True)
class Demo:
    """Simulate a scene, track it, and show the errors: the whole pipeline in one command."""

    config: Positional[Annotated[str, option("[CONFIG]")]] = ""
    """A YAML file; a cube and an L-bracket when not given."""
    output: _Output = None
    """Folder for the scene and the results."""
    quiet: bool = False
    """No progress bars."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting(quiet=self.quiet):
            from torchtrack.cli.demo import demo

        return demo(Path(self.config) if self.config else None, _given(self, ("config", "quiet")) | overrides, quiet=self.quiet)


@dataclass(frozen=True)
class Outline:
    """Make a polyline model from a picture: the outlines of dark shapes on a plane that faces the camera."""

    image: Positional[Annotated[str, arg(metavar="IMAGE")]]
    """What the camera saw."""
    calibration: Annotated[str, arg(metavar="FILE")]
    """Calibration of the camera."""
    output: Annotated[str, arg(aliases=["-o"], metavar="FILE")]
    """The polylines to write (.json)."""
    distance_m: float = 1.0
    """Distance of the plane (m); at the pose of no rotation and translation (0, 0, distance) the model lies on the picture."""
    width: _Number = None
    """Sensor width (px), where the calibration does not say it."""
    height: _Number = None
    """Sensor height (px), where the calibration does not say it."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        from torchtrack.cli.outline import outline

        refuse_settings(overrides)
        return outline(self.image, self.calibration, self.output, self.distance_m, self.width, self.height)


@dataclass(frozen=True)
class Model:
    """Say what a model is: size, unit, origin, surface, edges, texture, symmetries; and draw the contours that the tracker would use."""

    file: Positional[Annotated[str, arg(metavar="FILE")]]
    """A mesh (PLY, OBJ, STL, GLB, glTF, OFF), or polylines (JSON, or OBJ with lines)."""
    output: Annotated[str | None, option("FILE", "-o")] = None
    """The picture of six views to write (.png)."""
    unit: Annotated[Literal["m", "cm", "mm", "inch"] | None, option("UNIT")] = None
    """Unit of the file's numbers; the likeliest when not given."""
    scale: float = 1.0
    """Enlargement."""
    centre: bool = False
    """Have the middle of the model as its origin."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        from torchtrack.cli.model import show_model

        refuse_settings(overrides)
        return show_model(Path(self.file), self.unit, self.scale, None if self.output is None else Path(self.output), centre=self.centre)


@dataclass(frozen=True)
class Settings:
    """List the settings of a command, a line each; those of a group with type, bounds and the whole meaning."""

    command: Positional[Literal["track", "evaluate", "demo", "simulate"]] = "track"
    """The command."""
    group: Positional[str] = ""
    """A part of their names, such as tracker.motion: these alone, with type, bounds and the whole meaning."""
    markdown: bool = False
    """Print Markdown."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        from torchtrack.cli.settings import list_settings

        refuse_settings(overrides)
        return list_settings(self.command, self.group, markdown=self.markdown)


def _given(command: Any, without: tuple[str, ...]) -> dict[str, Any]:
    """The options of a command that were given and are settings, ready to be laid over a config file."""
    # A flag that is not there says nothing: the file may set it.
    values = {name: value for name, value in vars(command).items() if name not in without and value is not None and value is not False}
    return {name: CommandLineText(value) if isinstance(value, str) else value for name, value in values.items()}

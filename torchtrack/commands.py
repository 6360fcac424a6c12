"""What each command of the command line does, apart from parsing: settings in, work, tables out."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from torchtrack.config.demo import DemoConfig
from torchtrack.config.describe import described
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.executor import ExecutorName
from torchtrack.config.load import load, read_yaml
from torchtrack.config.run import RunConfig
from torchtrack.config.settings import CommandLineText, Settings
from torchtrack.core.files import naming
from torchtrack.errors import ConfigError
from torchtrack.eval.evaluate import evaluate as evaluate_all
from torchtrack.eval.evaluate import plan, report_of
from torchtrack.eval.grid import markdown
from torchtrack.eval.latency import estimate_latency
from torchtrack.eval.sources import find_sequences
from torchtrack.eval.tables import results_table, run_headline, run_table
from torchtrack.exit_codes import ExitCode
from torchtrack.io import read_calibration
from torchtrack.io.atomic import check_other_file
from torchtrack.outline import outline_dark_shapes, read_grey_image, write_polylines
from torchtrack.run.executor import TaskFailure
from torchtrack.run.runner import run, run_many
from torchtrack.run.session import open_session
from torchtrack.run.sinks.folder import check_folder
from torchtrack.run.sinks.progress import ProgressBar
from torchtrack.run.sinks.resume import check_resumable, is_complete
from torchtrack.run.sinks.summary import RunSummary
from torchtrack.sim import SceneConfig
from torchtrack.sim.suite import is_suite, run_suite, scenes_of, simulate_to_file
from torchtrack.sim.video import VideoConfig, write_video_events
from torchtrack.standard_streams import OutputConsole

# Tables need this much where the output is no terminal, which says how wide it is.
_FILE_WIDTH = 200


def output_console() -> Console:
    """Standard output, as wide as the terminal, or as tables need in a file or a pipe."""
    console = OutputConsole(highlight=False, soft_wrap=True)
    return console if console.is_terminal else OutputConsole(highlight=False, soft_wrap=True, width=_FILE_WIDTH)


def track(config_or_source: str, overrides: Mapping[str, Any], *, resume: bool = False, quiet: bool) -> int:
    """Track one source, or go on with that, show the summary; returns the exit code."""
    with naming(Path(config_or_source)):
        return _run(_run_config(config_or_source, overrides), quiet, resume)


def track_many(
    configs_or_sources: Sequence[str],
    overrides: Mapping[str, Any],
    *,
    streams: int = 1,
    jobs: int = 1,
    executor: ExecutorName = "local",
    resume: bool = False,
    quiet: bool,
) -> int:
    """Track several sources, show the summary of each as it comes; returns the exit code, which is not 0 where one failed.

    With ``resume`` those that are complete are left out, and those that ended early go on.
    """
    configs = [_in_own_folder(_run_config(text, overrides), Path(text).stem) for text in configs_or_sources]
    console, codes = output_console(), [ExitCode.DONE]
    for text in (text for text, config in zip(configs_or_sources, configs, strict=True) if resume and is_complete(config.output)):
        console.print(f"{text}: complete already, left out", markup=False)
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress:
        bar = progress.add_task("sources", total=len(configs))
        for number, outcome in run_many(configs, streams=streams, jobs=jobs, executor=executor, resume=resume):
            progress.advance(bar)
            if isinstance(outcome, TaskFailure):
                _tell_failure(f"{configs_or_sources[number]}: {outcome.reason}")
                codes.append(ExitCode.FAILED)
            else:
                codes.append(_show_run(console, outcome, configs[number].output))
    return max(codes)


def _in_own_folder(config: RunConfig, name: str) -> RunConfig:
    return config.model_copy(update={"output": config.output / name})


def _run_config(config_or_source: str, overrides: Mapping[str, Any]) -> RunConfig:
    """The settings of a run, from a YAML file or for a source that needs none."""
    if Path(config_or_source).suffix.lower() in (".yaml", ".yml"):
        return load(RunConfig, Path(config_or_source), overrides)
    return load(RunConfig, None, {"source": CommandLineText(config_or_source), **overrides})


def _run(config: RunConfig, quiet: bool, resume: bool = False) -> int:
    console = output_console()
    if resume:
        check_resumable(config)
    check_folder(config.output)
    session = open_session(config)
    if config.compiled and not quiet:
        Console(stderr=True).print("compiling the tracker, which takes a minute or two for the first time")
    progress = [] if quiet else [ProgressBar(Console(stderr=True), session.name, session.known_duration_s)]
    return _show_run(console, run(config, progress, session, resume=resume), config.output)


def _show_run(console: Console, summary: RunSummary, output: Path) -> ExitCode:
    """Show what came of a run; returns the exit code."""
    console.print(run_headline(summary))
    console.print(run_table(summary))
    if summary.joined_windows or summary.dropped_windows:
        left_out = f"{summary.dropped_windows} were dropped, {summary.dropped_events} events left out"
        console.print(f"events came too fast: {summary.joined_windows} windows were joined with the next, {left_out}")
    console.print(f"Results are in {output}")
    return ExitCode.INTERRUPTED if summary.interrupted else ExitCode.DONE


def evaluate(config_file: str | None, given: Mapping[str, Any], overrides: Mapping[str, Any], chosen: Sequence[str] | None, *, quiet: bool) -> int:
    """Evaluate sequences, show the table; returns the exit code, which is not 0 where a sequence failed."""
    console = output_console()
    path = Path(config_file) if config_file else None
    config = load(EvaluateConfig, path, _method_overrides(path, overrides, chosen) | dict(given))
    if chosen is not None:
        config = config.model_copy(update={"methods": {label: config.methods[label] for label in chosen}})
    # What is wrong is told with the file that asks for it.
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress, naming(path):
        planned = plan(config, _scene_progress(progress))
        bar = progress.add_task("sequences", total=len(planned.jobs))
        evaluation = evaluate_all(config, lambda job: progress.advance(bar), planned)
    if report := report_of(evaluation, config, planned):
        for grid in report.grids:
            # As it is: markup and wrapping would break it.
            console.print(markdown(grid), markup=False, no_wrap=True, overflow="ignore", crop=False, end="\n\n")
    else:
        console.print(results_table(evaluation))
    for reason in dict.fromkeys(f"{entry.method}: {entry.reason}" for entry in evaluation.not_applicable):
        console.print(f"- {reason}", markup=False)
    console.print(f"Results are in {config.output}")
    for failure in evaluation.failures:
        _tell_failure(f"{failure.sequence} ({failure.method}): {failure.reason}")
    return ExitCode.FAILED if evaluation.failures else ExitCode.DONE


def _tell_failure(text: str) -> None:
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"failed: {text}", markup=False)


def show_latency(paths: Sequence[str]) -> int:
    """Show how late the events of sequences are against their ground truth; returns the exit code."""
    table = Table("sequence", "latency (µs)", "± (µs)", "lag (px)", "distance before → after (px)", header_style="bold")
    for path in find_sequences([Path(text) for text in paths]):
        found = estimate_latency(open_session(RunConfig(source=path)))
        row = (f"{found.latency_us:.0f}", f"{found.deviation_us:.0f}", f"{found.lag_px:.2f}", f"{found.before_px:.2f} → {found.after_px:.2f}")
        table.add_row(path.stem, *row)
    console = output_console()
    console.print(table)
    console.print("The setting sensor_latency_us of a run takes a latency off.")
    return ExitCode.DONE


def _scene_progress(progress: Progress) -> Callable[[str, float], None]:
    """Shows how far each scene is simulated."""
    bars: dict[str, TaskID] = {}

    def show(name: str, share: float) -> None:
        if name not in bars:
            bars[name] = progress.add_task(f"simulating {name}", total=1.0)
        progress.update(bars[name], completed=share)

    return show


def simulate(config_file: str, output: str, overrides: Mapping[str, Any], *, jobs: int, executor: ExecutorName, preview: bool, quiet: bool) -> int:
    """Simulate a scene into a sequence, or a suite into a folder; returns the exit code, which is not 0 where a scene failed."""
    file, target = Path(config_file), Path(output)
    if not is_suite(file) or (not file.is_dir() and "variant" in overrides):
        if executor != "local":
            raise ConfigError(f"command line: --executor {executor} is for several scenes, and '{config_file}' is one.")
        scene = load(SceneConfig, file, overrides)
        with naming(file):
            path = _simulated(scene, target if target.suffix else target / f"{scene.name}.npz", quiet, preview)
        output_console().print(f"The sequence is in {path}")
        return ExitCode.DONE
    if target.suffix:
        raise ConfigError(f"'{file}' holds several scenes: give a folder in place of '{target}', or choose one with --variant.")
    scenes = scenes_of(file, overrides)
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress:
        bars = {scene.name: progress.add_task(scene.name, total=1.0) for scene in scenes}
        failures = run_suite(
            scenes, target, jobs, lambda name, share: progress.update(bars[name], completed=share), preview=preview, executor=executor
        )
    output_console().print(f"{len(scenes) - len(failures)} of {len(scenes)} sequences are in {target}")
    for failure in failures:
        _tell_failure(f"{failure.name}: {failure.reason}")
    return ExitCode.FAILED if failures else ExitCode.DONE


def simulate_video(given: Mapping[str, Any], output: str, overrides: Mapping[str, Any]) -> int:
    """Turn a video, or a folder of images, into events; returns the exit code."""
    config = load(VideoConfig, None, {**given, **overrides})
    count = write_video_events(config, Path(output))
    output_console().print(f"{count} events are in {output}")
    return ExitCode.DONE


def _simulated(scene: SceneConfig, path: Path, quiet: bool, preview: bool = False) -> Path:
    with Progress(console=Console(stderr=True), transient=True, disable=quiet) as progress:
        bar = progress.add_task(f"simulating {scene.name}", total=1.0)
        return simulate_to_file(scene, path, lambda share: progress.update(bar, completed=share), preview=preview)


def demo(config_file: str, overrides: Mapping[str, Any], *, quiet: bool) -> int:
    """Simulate a scene, track it, show the errors; returns the exit code."""
    config = load(DemoConfig, Path(config_file), overrides)
    scene = load(SceneConfig, config.scene)
    with naming(config.scene):
        sequence = _simulated(scene, config.output / f"{scene.name}.npz", quiet)
    shared = {name: getattr(config, name) for name in DemoConfig.model_fields if name in RunConfig.model_fields}
    return _run(RunConfig(source=sequence, **shared), quiet)


def outline(image: str, calibration: str, output: str, distance_m: float, width: int | None, height: int | None) -> int:
    """Write a polyline model of the dark shapes of a picture; returns the exit code."""
    for source in (image, calibration):
        check_other_file(Path(source), Path(output))
    camera = read_calibration(calibration, width, height)
    lines = outline_dark_shapes(read_grey_image(Path(image)), camera, distance_m)
    write_polylines(Path(output), lines)
    output_console().print(f"{len(lines)} outlines are in {output}")
    return ExitCode.DONE


def _method_overrides(config_file: Path | None, overrides: Mapping[str, Any], chosen: Sequence[str] | None) -> dict[str, Any]:
    """Overrides with what names no method laid over every one; a chosen method that the file does not know is a preset."""
    given = (read_yaml(config_file) if config_file else {}).get("methods")
    # Anything else is told when the settings are checked.
    of_file = given if isinstance(given, dict) else {}
    labels = list(chosen or of_file or ["default"])
    result = {f"methods.{label}.preset": CommandLineText(label) for label in labels if label not in of_file}
    for key, value in overrides.items():
        keys = [f"methods.{label}.{key}" for label in labels] if key.startswith("tracker.") else [key]
        result |= dict.fromkeys(keys, value)
    return result


def list_settings(command: str) -> int:
    """Show every setting of a command; returns the exit code."""
    table = Table("setting", "type", "default", "meaning", header_style="bold", box=None)
    settings: dict[str, type[Settings]] = {"track": RunConfig, "evaluate": EvaluateConfig, "demo": DemoConfig, "simulate": SceneConfig}
    for row in described(settings[command]):
        table.add_row(*row)
    output_console().print(table)
    return ExitCode.DONE

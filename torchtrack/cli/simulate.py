"""``torchtrack simulate``: scenes, suites, and events of a video."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchtrack.cli.console import output_console, tell_failure
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.progress import progress_shown, share_of
from torchtrack.config.executor import ExecutorName
from torchtrack.config.load import load
from torchtrack.core.files import naming
from torchtrack.errors import ConfigError
from torchtrack.sim import SceneConfig
from torchtrack.sim.suite import is_suite, run_suite, scenes_of, simulate_to_file
from torchtrack.sim.video import VideoConfig, write_video_events


def simulate(config_file: str, output: str, overrides: Mapping[str, Any], *, jobs: int, executor: ExecutorName, preview: bool, quiet: bool) -> int:
    """Simulate a scene into a sequence, or a suite into a folder; returns the exit code, which is not 0 where a scene failed."""
    file, target = Path(config_file), Path(output)
    if not is_suite(file) or (not file.is_dir() and "variant" in overrides):
        if executor != "local":
            raise ConfigError(f"command line: --executor {executor} is for several scenes, and '{config_file}' is one.")
        scene = load(SceneConfig, file, overrides)
        with naming(file):
            path = simulated_to(scene, target if target.suffix else target / f"{scene.name}.npz", quiet, preview)
        output_console().print(f"The sequence is in {path}")
        return ExitCode.DONE
    if target.suffix:
        raise ConfigError(f"'{file}' holds several scenes: give a folder in place of '{target}', or choose one with --variant.")
    scenes = scenes_of(file, overrides)
    with progress_shown(quiet=quiet) as progress:
        bars = {scene.name: progress.add_task(scene.name, total=1.0) for scene in scenes}
        failures = run_suite(
            scenes, target, jobs, lambda name, share: progress.update(bars[name], completed=share), preview=preview, executor=executor
        )
    output_console().print(f"{len(scenes) - len(failures)} of {len(scenes)} sequences are in {target}")
    for failure in failures:
        tell_failure(f"{failure.name}: {failure.reason}")
    return ExitCode.FAILED if failures else ExitCode.DONE


def simulate_video(given: Mapping[str, Any], output: str, overrides: Mapping[str, Any], *, quiet: bool) -> int:
    """Turn a video, or a folder of images, into events; returns the exit code."""
    config = load(VideoConfig, None, {**given, **overrides})
    with progress_shown(quiet=quiet) as progress:
        count = write_video_events(config, Path(output), share_of(progress, f"events of {config.video.name}"))
    output_console().print(f"{count} events are in {output}")
    return ExitCode.DONE


def simulated_to(scene: SceneConfig, path: Path, quiet: bool, preview: bool = False) -> Path:
    """Simulate a scene into a file, with a progress bar."""
    with progress_shown(quiet=quiet) as progress:
        return simulate_to_file(scene, path, share_of(progress, f"simulating {scene.name}"), preview=preview)

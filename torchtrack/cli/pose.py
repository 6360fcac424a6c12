"""``torchtrack pose``: the first pose of an object in a recording, as the block of a config."""

import math
import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchtrack.cli.console import error_console, output_console
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.picture import check_picture, write_picture
from torchtrack.cli.progress import progress_shown, share_of
from torchtrack.config.load import load
from torchtrack.config.run import ObjectConfig, RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.core.atomic import atomic_path, check_other_file, check_writable
from torchtrack.core.files import naming
from torchtrack.errors import ConfigError, EventDataError, TorchtrackWarning, UnknownFormatError
from torchtrack.run.first_pose.config_text import as_config
from torchtrack.run.first_pose.in_browser import pose_in_browser
from torchtrack.run.first_pose.picks import pose_of_picks, read_picks
from torchtrack.run.first_pose.picture import draw_start
from torchtrack.run.first_pose.request import as_block, known_pose, object_of, opened, parsed_box, placed_picks, read_near
from torchtrack.run.first_pose.searching import pose_in_box, pose_near, refined_pose
from torchtrack.run.first_pose.start import Start
from torchtrack.run.first_pose.tracked import FirstPose
from torchtrack.run.runner import threads
from torchtrack.run.session import Session
from torchtrack.tracking.start_check import check_in_view

# A pose whose contours explain less than this may be a wrong one.
_DOUBTFUL_QUALITY = 0.5
# Where the page is served, if nothing else is asked for; viser's own.
_PORT = 8080


@dataclass(frozen=True)
class Ways:
    """How the pose is to be come by: one of these.

    Args:
        points: a file of picks.
        near: a file with a rough pose.
        search: whether it is looked for, in the ``box`` where that is given.
        box: as typed.
        browser: whether somebody makes it by hand, on a page that is served at the ``port``.
    """

    points: Path | None = None
    near: Path | None = None
    search: bool = False
    box: str | None = None
    browser: bool = False
    port: int | None = None

    def check(self) -> None:
        """Refuse none, or several of them.

        Raises:
            ConfigError: then.
        """
        ways = {"--points": self.points, "--near": self.near, "--search": self.search, "--browser": self.browser}
        given = [name for name, value in ways.items() if value]
        if len(given) != 1:
            got = " and ".join(given) or "none of them"
            raise ConfigError(f"command line: pose needs one of --points FILE, --near FILE, --search [--box u0,v0,u1,v1] or --browser, got {got}.")
        if self.box is not None and not self.search:
            raise ConfigError("command line: --box is where to --search, and of no use otherwise.")
        if self.port is not None and not self.browser:
            raise ConfigError("command line: --port is where the page of --browser is, and of no use otherwise.")


@dataclass(frozen=True)
class Written:
    """Where the pose goes.

    Args:
        block: the file of the ``initial_pose`` block; None for the terminal.
        config: the file of a config with the pose; None for no config.
        picture: the file of a picture of it; None for no picture.
    """

    block: Path | None = None
    config: Path | None = None
    picture: Path | None = None

    def check(self, read: Iterable[Path]) -> None:
        """Refuse files that could not be written, or that are read.

        Raises:
            OutputError, UnknownFormatError: then.
        """
        for path in filter(None, (self.block, self.config, self.picture)):
            for other in read:
                check_other_file(other, path)
            check_writable(path)
        if self.config is not None and self.config.suffix.lower() not in (".yaml", ".yml"):
            raise UnknownFormatError(f"'{self.config}': configs are .yaml files. Give it such a name.")
        if self.picture is not None:
            check_picture(self.picture)


def write_pose(source: str, settings: dict[str, Any], ways: Ways, label: str | None, written: Written) -> int:
    """Find the first pose of an object, and show or write it; returns the exit code.

    Args:
        source: a recording, a sequence, or a config of ``torchtrack track``.
        settings: of the run, by dotted key.
        label: of the object, where there are several.
        written: where it goes.
    """
    ways.check()
    with naming(Path(source)):
        config = _run_config(source, settings)
    written.check(tuple(filter(None, (Path(source), ways.points, ways.near))))
    obj, begun = object_of(config, label), time.perf_counter()
    # Somebody who makes it by hand sees what goes on.
    with threads(config.threads), naming(Path(source)), progress_shown(quiet=ways.browser) as progress:
        share_of(progress, f"looking for the pose of {obj.label}")
        session = opened(config, obj)
        pose = _pose(ways, session, obj)
        check_in_view(pose.T_cam_obj[None], session.models, [session.camera])
        if written.picture is not None:
            start = Start.from_events(session.models[0], session.camera, session.events, pose.at_us)
            write_picture(written.picture, draw_start(start, pose, obj.label))
    _tell(pose, obj.label, time.perf_counter() - begun)
    if written.config is not None:
        _write(written.config, as_config(config, obj.label, pose, written.config.absolute().parent))
    _show(as_block(pose.T_cam_obj, obj.label, pose.at_us), written)
    return ExitCode.DONE


def _run_config(source: str, settings: dict[str, Any]) -> RunConfig:
    if Path(source).suffix.lower() in (".yaml", ".yml"):
        return load(RunConfig, Path(source), settings)
    return load(RunConfig, None, {"source": CommandLineText(source), **settings})


def _pose(ways: Ways, session: Session, obj: ObjectConfig) -> FirstPose:
    if ways.browser:
        return pose_in_browser(session, known_pose(obj, session.start_us), _PORT if ways.port is None else ways.port, _tell_address)
    start = Start.from_session(session)
    if ways.points is not None:
        return _pose_of_picks(ways.points, start, obj)
    if ways.near is not None:
        return pose_near(start, read_near(ways.near, obj.label, start.at_us))
    return pose_in_box(start, None if ways.box is None else parsed_box(ways.box, start.camera))


def _pose_of_picks(path: Path, start: Start, obj: ObjectConfig) -> FirstPose:
    T_cam_obj = pose_of_picks(placed_picks(read_picks(path), obj), start.camera)
    try:
        return refined_pose(start, T_cam_obj)
    except EventDataError as error:
        warnings.warn(f"the pose is that of the picks alone, not refined: {error}", TorchtrackWarning, stacklevel=2)
        return FirstPose(T_cam_obj, start.at_us, torch.nan)


def _tell_address(url: str) -> None:
    port = url.rpartition(":")[2]
    _say(f"Make the pose at {url} and press Save there. From another machine: ssh -L {port}:localhost:{port} THIS_MACHINE, then the same address.")


def _tell(pose: FirstPose, label: str, seconds: float) -> None:
    """Say how good the pose is."""
    explained = "it was not refined on the events" if math.isnan(pose.quality) else f"events explain {100 * pose.quality:.0f} % of its moving contour"
    _say(f"'{label}': {explained}; {seconds:.1f} s")
    if pose.quality < _DOUBTFUL_QUALITY:
        message = (
            f"the events explain {100 * pose.quality:.0f} % of the contour of '{label}': the pose may be wrong. Look at it with "
            "--picture FILE.png, check the model and its unit, or give a box, more points, or another time (--at-us)."
        )
        warnings.warn(message, TorchtrackWarning, stacklevel=2)


def _show(block: str, written: Written) -> None:
    if written.block is not None:
        _write(written.block, block)
        output_console().print(f"the pose is in {written.block}", markup=False)
    elif written.config is None:
        output_console().print(block, markup=False, end="")
    if written.config is not None:
        output_console().print(f"a config with the pose is in {written.config}: torchtrack track {written.config}", markup=False)
    if written.picture is not None:
        _say(f"its contours on the events are in {written.picture}")


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _say(text: str) -> None:
    """On stderr: the terminal's output is the block."""
    error_console().print(text, markup=False)

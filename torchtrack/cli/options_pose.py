"""The options of the command ``pose``, as the command line types them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from torchtrack.cli.console import starting
from torchtrack.cli.option import option
from torchtrack.config.settings import CommandLineText
from torchtrack.errors import ConfigError

_File = Annotated[str | None, option("FILE")]


@dataclass(frozen=True)
class Pose:
    """Find the first pose of an object in a recording, and write it as the initial_pose block of a config."""

    recording: Positional[Annotated[str, arg(metavar="RECORDING|CONFIG")]]
    """Events, a sequence, or a config of `torchtrack track` with source, camera and objects."""
    mesh: _File = None
    """The object's mesh."""
    calibration: _File = None
    """Calibration of the camera; a sequence brings its own."""
    points: _File = None
    """CSV file of picked points, u,v,x,y,z: pixels, and the mesh file's own numbers."""
    near: _File = None
    """Look near the pose in this file: one that this command wrote, or a config."""
    search: bool = False
    """Look for the object in all rotations."""
    box: Annotated[str | None, option("u0,v0,u1,v1")] = None
    """Where it is in the image (px); by default around what moves most."""
    browser: bool = False
    """Make the pose by hand on a page in the browser, with the object, its contours and the events (extra `viz`)."""
    port: Annotated[int | None, option("N")] = None
    """Where that page is; by default 8080, or the next free one."""
    at_us: Annotated[int | None, option("N")] = None
    """Time of the pose, in stream time (µs); by default the start."""
    unit: Annotated[Literal["m", "cm", "mm", "inch"] | None, option("UNIT")] = None
    """Unit of the mesh file's numbers; m when not given."""
    scale: Annotated[float | None, option("N")] = None
    """Enlargement of the mesh."""
    centre: bool = False
    """Have the middle of the mesh as the origin that poses are of."""
    label: Annotated[str | None, option("NAME")] = None
    """Which object of a config."""
    output: Annotated[str | None, option("FILE", "-o")] = None
    """The file to write (.yaml); by default the terminal."""
    config: _File = None
    """Also write a config of `torchtrack track` with the pose and all that is said here (.yaml), ready to be run."""
    picture: _File = None
    """Also draw the contours at the pose on the events, into this file (.png)."""

    def run(self, overrides: dict[str, Any]) -> int:
        """Carry the command out; returns the exit code."""
        with starting():
            from torchtrack.cli.pose import Ways, Written, write_pose

        ways = Ways(_path(self.points), _path(self.near), self.search, self.box, self.browser, self.port)
        written = Written(_path(self.output), _path(self.config), _path(self.picture))
        return write_pose(self.recording, self._settings() | overrides, ways, self.label, written)

    def _settings(self) -> dict[str, Any]:
        """What is given of the object, the camera and the time, as settings of a run."""
        settings: dict[str, Any] = {}
        placed = {"unit": self.unit, "scale": self.scale, "centre": self.centre or None}
        placed = {name: value for name, value in placed.items() if value is not None}
        if self.mesh is not None:
            label = self.label or "".join(mark if mark.isalnum() or mark in "_.-" else "_" for mark in Path(self.mesh).stem)
            settings["objects"] = [{"label": label, "mesh": CommandLineText(self.mesh), **placed}]
        elif placed:
            raise ConfigError(f"command line: {', '.join(placed)}: of the file that --mesh names; a config says it beside its own mesh.")
        if self.calibration is not None:
            settings["camera.calibration"] = CommandLineText(self.calibration)
        if self.at_us is not None:
            settings["start_us"] = self.at_us
        return settings


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)

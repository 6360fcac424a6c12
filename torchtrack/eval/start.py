"""Initial poses that are off: by a given angle, or by so little that a run differs from another in roundings alone."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import torch

from torchtrack.core.lie import so3_exp
from torchtrack.run.session import Session

# About eight units in the last place of a rotation in single precision: no tracker can tell it, and every rounding after it differs.
_ROUNDING_RAD = 1e-6


@dataclass(frozen=True)
class StartError:
    """How far the initial poses of a run are off.

    Args:
        angle_deg: angle by which every object is turned about its origin; the axis is drawn by the names of sequence and object.
        run: number of the run; from the second on, objects are turned by 1e-6 rad as well, in each run about another axis.
    """

    angle_deg: float = 0.0
    run: int = 1

    def applied(self, session: Session) -> Session:
        """The session with its initial poses turned."""
        T = session.T_cam_obj.clone()
        for number, label in enumerate(session.labels):
            name = f"{session.name}/{label}"
            if self.angle_deg:
                T[number, :3, :3] = so3_exp(math.radians(self.angle_deg) * _drawn_axis(name)) @ T[number, :3, :3]
            if self.run > 1:
                T[number, :3, :3] = so3_exp(_ROUNDING_RAD * _drawn_axis(f"{name}/{self.run}")) @ T[number, :3, :3]
        return replace(session, T_cam_obj=T)


def start_angle_deg(name: str, angles_deg: Mapping[str, float]) -> float:
    """By how much a sequence of this name is turned at its start: what the first pattern says that fits, else 0."""
    return next((angle for pattern, angle in angles_deg.items() if fnmatchcase(name, pattern)), 0.0)


def _drawn_axis(text: str) -> torch.Tensor:
    """A unit vector, the same for the same text on every machine."""
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big")
    axis = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return axis / axis.norm()

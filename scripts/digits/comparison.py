"""Two lists of numbers of windows: whether they are the same, and if not, where they first differ."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

Numbers = Mapping[str, torch.Tensor]

# Fields of results that have another name here than in the tree at BASE: ``{"name there": "name here"}``. A dotted name stands for all
# that is under it; None is for what is no longer there. For ADDED there is nothing to compare. To be emptied when BASE moves on.
RENAMED: dict[str, str | None] = {}
ADDED: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Difference:
    """Where two trees part: the first window (numbered from 0), the field by its name here, and what the difference is."""

    window: int
    field: str
    what: str


def name_here(name: str, renamed: Mapping[str, str | None]) -> str | None:
    """The name here of a field of the tree at BASE; None where there is none."""
    for end in range(len(parts := name.split(".")), 0, -1):
        there = ".".join(parts[:end])
        if there in renamed:
            here = renamed[there]
            return None if here is None else ".".join([here, *parts[end:]])
    return name


def first_difference(
    base: Sequence[Numbers], here: Sequence[Numbers], renamed: Mapping[str, str | None] | None = None, added: frozenset[str] = ADDED
) -> Difference | None:
    """The first difference between the windows of two trees, or None. What is not a number is the same as what is not a number.

    Args:
        base, here: the fields of every window, of the tree at BASE and of the one here.
        renamed, added: as :data:`RENAMED` and :data:`ADDED`, which are taken when not given.
    """
    renamed = RENAMED if renamed is None else renamed
    for window, (fields_there, theirs) in enumerate(zip(base, here, strict=False)):
        named = {here_as: value for name, value in fields_there.items() if (here_as := name_here(name, renamed)) is not None}
        for field in theirs:
            if field not in named and field not in added:
                return Difference(window, field, "only the tree here has it; list it in RENAMED or ADDED")
        for field, value in named.items():
            what = _unequal(value, theirs[field]) if field in theirs else "only the tree at BASE has it; list it in RENAMED"
            if what:
                return Difference(window, field, what)
    if len(base) != len(here):
        return Difference(min(len(base), len(here)), "windows", f"{len(base)} windows at BASE, {len(here)} here")
    return None


def _unequal(there: torch.Tensor, here: torch.Tensor) -> str | None:
    """How two tensors differ, or None."""
    if there.shape != here.shape or there.dtype != here.dtype:
        return f"{there.dtype} {list(there.shape)} at BASE, {here.dtype} {list(here.shape)} here"
    same = there == here
    if there.is_floating_point():
        same |= there.isnan() & here.isnan()
    if bool(same.all()):
        return None
    first = tuple((~same).nonzero()[0].tolist())
    apart = (there.double() - here.double()).abs()[~same]
    return (
        f"{int((~same).sum())} of {same.numel()} numbers differ, by up to {float(apart.max()):.3g}; "
        f"the first is {there[first].item()!r} at BASE, {here[first].item()!r} here, at {list(first)}"
    )


def is_searched_for(windows: Sequence[Numbers], focal_px: float) -> bool:
    """Whether an object was found again by a search: its centre jumped across the image, and it was not lost at the end.

    No prediction is corrected by so much in one window without one.
    """
    place = torch.stack([fields["T_cam_obj"][0, :3, 3] for fields in windows])
    pixels = focal_px * place[:, :2] / place[:, 2:]
    jump = (pixels[2:] - 2 * pixels[1:-1] + pixels[:-2]).norm(dim=1)
    return float(jump.max()) > 12 and int(windows[-1]["status"][0]) <= 1

"""Damaged files, thousands of them, through every reader: counts what came of them, and shows each that was no result and no clear error."""

import os
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

# Before PyTorch is loaded: processes that fork must have one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
import tyro
from hostile import hostile_inputs
from mutations import mutated
from outcomes import FAULTS, Input, Outcome, outcomes
from rich.console import Console
from seeds import Seed, make_seeds
from targets import TARGETS

_SEED = 20_241_128


@dataclass(frozen=True)
class Arguments:
    """Read damaged files; the exit code is 1 if any gave a traceback, a hang, more than 2 GB of memory, or an error without its file's name."""

    count: Annotated[int, tyro.conf.arg(metavar="N")] = 10_000
    """Mutated files; the hostile ones that are made by hand come on top."""
    first: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Number of the first one."""
    only: Annotated[str | None, tyro.conf.arg(metavar="N|NAME")] = None
    """One input, by the number or the name that was shown; a name ending in * for several."""
    keep: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """With --only: put the input into this folder, and do not read it."""
    kind: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Mutate only seeds whose name begins so."""
    hostile: bool = True
    """Read also those that are made by hand."""
    jobs: Annotated[int, tyro.conf.arg(metavar="N", aliases=["-j"])] = 2
    """Processes."""
    each: bool = False
    """Show how many mutated files of each seed gave a result."""
    slowest: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Show the slowest of them."""


def main(arguments: Arguments) -> int:
    """Make the inputs, read them, tell what came of them."""
    torch.set_num_threads(1)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    with tempfile.TemporaryDirectory(prefix="torchtrack-fuzz-") as name:
        folder = Path(name)
        (folder / "seeds").mkdir()
        seeds = make_seeds(folder / "seeds")
        if arguments.kind is not None:
            seeds = [seed for seed in seeds if seed.name.startswith(arguments.kind)]
        # Processes of their own make even what is only asked for, so that memory and crashes count there.
        inputs = _chosen(arguments, seeds, folder / "seeds")
        if arguments.keep is not None:
            arguments.keep.mkdir(parents=True)
            console.print(f"{inputs[0].prepare(arguments.keep)}")
            return 0
        shown = [_reported(outcome, console) for outcome in outcomes(inputs, folder, arguments.jobs)]
    for outcome in sorted(shown, key=lambda outcome: -outcome.seconds)[: arguments.slowest]:
        console.print(f"{outcome.seconds:6.1f} s  {outcome.name}: {outcome.kind}")
    if arguments.each:
        _show_each(shown, seeds, console)
    counts = Counter(outcome.kind for outcome in shown)
    console.print(", ".join(f"{counts[kind]} {kind}" for kind in ("result", "clear error", *FAULTS)) + f", of {len(shown)}")
    return int(any(counts[kind] for kind in FAULTS))


def _chosen(arguments: Arguments, seeds: list[Seed], folder: Path) -> list[Input]:
    hostile = hostile_inputs(seeds, folder)
    wanted = arguments.only
    if wanted is not None and wanted.isdigit():
        return [_mutation(int(wanted), seeds, folder)]
    if wanted is not None:
        matches = [item for item in hostile if item.name == wanted or (wanted.endswith("*") and item.name.startswith(wanted[:-1]))]
        if not matches:
            sys.exit(f"no hostile input is called '{wanted}'; there are {', '.join(item.name for item in hostile)}")
        return matches
    numbers = range(arguments.first, arguments.first + arguments.count)
    return [*(hostile if arguments.hostile and arguments.kind is None else ()), *(_mutation(number, seeds, folder) for number in numbers)]


def _mutation(number: int, seeds: list[Seed], folder: Path) -> Input:
    """The input of a number: the same bytes whenever it is asked for."""
    seed = seeds[number % len(seeds)]
    names = (Path(seed.mutated).name, Path(seed.opened).name, seed.folder.name)
    return Input(str(number), partial(_put, number, seed, seeds, folder), TARGETS[seed.kind], names)


def _put(number: int, seed: Seed, seeds: list[Seed], folder: Path, target: Path) -> Path:
    random = np.random.default_rng([_SEED, number])
    alike = [other for other in seeds if other.kind == seed.kind]
    other = alike[int(random.integers(len(alike)))]
    content = mutated((seed.folder / seed.mutated).read_bytes(), (other.folder / other.mutated).read_bytes(), random)
    # Other seeds lie beside it as they are: configs name them.
    for neighbour in seeds:
        if neighbour is not seed:
            (target / neighbour.name).symlink_to(folder / neighbour.name)
    own = target / seed.name
    own.mkdir()
    for file in sorted(path for path in seed.folder.rglob("*") if path.is_file()):
        place = own / file.relative_to(seed.folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content if file == seed.folder / seed.mutated else file.read_bytes())
    return own / seed.opened


def _show_each(shown: list[Outcome], seeds: list[Seed], console: Console) -> None:
    mutated = [outcome for outcome in shown if outcome.name.isdigit()]
    total = Counter(seeds[int(outcome.name) % len(seeds)].name for outcome in mutated)
    read = Counter(seeds[int(outcome.name) % len(seeds)].name for outcome in mutated if outcome.kind == "result")
    for name, count in total.items():
        console.print(f"{name}: {read[name]} of {count} were read")


def _reported(outcome: Outcome, console: Console) -> Outcome:
    if outcome.kind in FAULTS:
        console.print(f"\n{outcome.name}: {outcome.kind} ({outcome.seconds:.1f} s)\n{outcome.detail}")
    return outcome


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))

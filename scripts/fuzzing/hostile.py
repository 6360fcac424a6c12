"""Inputs that were made by hand to be large, slow, endless or mad, each with a name of its own."""

import os
import shutil
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
from hostile_arrays import array_inputs
from hostile_models import model_inputs
from hostile_text import text_inputs
from hostile_times import time_inputs
from outcomes import Input
from seeds import Seed
from targets import SIZE, TARGETS

from torchtrack.io import open_events

Make = Callable[[Path], None]
_OPENERS = {
    "events": "x.raw", "sequence": "x.npz", "calibration": "x.yaml", "poses": "x.csv", "mesh": "x.ply", "lines": "x.json",
    "track": "x.yaml", "evaluate": "x.yaml", "simulate": "x.yaml", "demo": "x.yaml",
}  # fmt: skip


def hostile_inputs(seeds: list[Seed], folder: Path) -> list[Input]:
    """All of them."""
    made = [*_no_files(), *_large_sensors(), *text_inputs(), *array_inputs(), *time_inputs(), *model_inputs()]
    inputs = [Input(name, partial(_prepared, make, file, folder), TARGETS[kind], (file,)) for name, kind, file, make in made]
    shrinking = (seed for seed in seeds if seed.kind == "events")
    inputs += [Input(f"shrinks_{s.name}", partial(_copied, s), partial(_read_while_it_shrinks, s.mutated), (s.mutated, "bag")) for s in shrinking]
    return inputs


def _prepared(make: Make, file: str, seeds: Path, target: Path) -> Path:
    for neighbour in seeds.iterdir():
        (target / neighbour.name).symlink_to(neighbour)
    (target / "own").mkdir()
    make(target / "own" / file)
    return target / "own" / file


def _copied(seed: Seed, target: Path) -> Path:
    shutil.copytree(seed.folder, target / "own")
    return target / "own" / seed.opened


def _read_while_it_shrinks(mutated: str, path: Path) -> None:
    source = open_events(path, **SIZE) if path.suffix in (".txt", ".zip") else open_events(path)
    file = path if path.is_file() else path / Path(mutated).name
    with file.open("r+b") as stream:
        stream.truncate(file.stat().st_size // 2)
    for chunk in source.chunks(50):
        torch.aminmax(chunk.t_us)
    source.info()


def _no_files() -> Iterator[tuple[str, str, str, Make]]:
    """What stands where a file is expected."""
    for kind, file in _OPENERS.items():
        yield f"fifo_{kind}", kind, file, os.mkfifo
        yield f"folder_{kind}", kind, file, Path.mkdir
        yield f"nothing_{kind}", kind, file, lambda path: None
        yield f"empty_{kind}", kind, file, Path.touch
        yield f"device_{kind}", kind, file, lambda path: path.symlink_to("/dev/zero")
        yield f"loop_{kind}", kind, file, lambda path: path.symlink_to(path)
        yield f"nulls_{kind}", kind, file, lambda path: path.write_bytes(bytes(1 << 16))
        yield f"sparse_{kind}", kind, file, lambda path: _sparse(path, 3 << 30)
    yield "folder_with_fifo", "events", "bag", _folder_with_fifo
    for suffix in (".npz", ".h5", ".txt", ".csv", ".bag", ".aedat4", ".dat", ".es"):
        yield f"fifo{suffix}", "events", f"x{suffix}", os.mkfifo
        yield f"sparse{suffix}", "events", f"x{suffix}", lambda path: _sparse(path, 3 << 30)


def _sparse(path: Path, size: int) -> None:
    with path.open("wb") as stream:
        stream.truncate(size)


def _folder_with_fifo(path: Path) -> None:
    path.mkdir()
    os.mkfifo(path / "metadata.yaml")


def _large_sensors() -> Iterator[tuple[str, str, str, Make]]:
    """Headers that declare sensors of 65536x65536 and more."""
    yield "sensor_csv", "events", "x.csv", lambda path: path.write_text("# width=65536 height=65536\n1000,1,2,1\n2000,3,4,0\n")
    yield "sensor_raw", "events", "x.raw", lambda path: path.write_bytes(b"% evt 3.0\n% geometry 65536x65536\n% end\n" + bytes(100))
    yield "sensor_dat", "events", "x.dat", lambda path: path.write_bytes(b"% Version 2\n% Width 65536\n% Height 65536\n\x00\x08" + bytes(80))
    head = b"Event Stream\x02\x00\x00\x01" + struct.pack("<HH", 65535, 65535)
    yield "sensor_es", "events", "x.es", lambda path: path.write_bytes(head + bytes(100))
    camera = "source: ../sequence/scene.npz\ncamera: {fx: 9000, fy: 9000, cx: 4000, cy: 4000, width: 8192, height: 8192}\n"
    yield "sensor_config", "track", "x.yaml", lambda path: path.write_text(camera)
    yield "sensor_calibration", "calibration", "x.yaml", lambda path: path.write_text("fx: 9\nfy: 9\ncx: 9\ncy: 9\nwidth: 65536\nheight: 65536\n")
    text = "fx: 9000\nfy: 9000\ncx: 4000\ncy: 4000\nwidth: 8192\nheight: 8192\ndistortion_model: plumb_bob\ndistortion: [-0.1, 0.01, 0, 0, 0]\n"
    yield "sensor_distorted", "calibration", "x.yaml", lambda path: path.write_text(text)
    yield (
        "sensor_scene",
        "simulate",
        "x.yaml",
        lambda path: path.write_text("objects: [{label: a, shape: cube}]\ncamera: {width: 4096, height: 4096}\n"),
    )

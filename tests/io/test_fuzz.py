"""Files with bytes changed, cut out, doubled or cut off: they are read as far as they go, or an error of ours says why not.

A quick part runs always; ``TORCHTRACK_FUZZ=10000`` runs so many files or more, over all formats.
"""

import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, save_npz
from tiny_sequence import write_tiny_sequence

from torchtrack.errors import TorchtrackError
from torchtrack.io import open_events, read_sequence
from torchtrack.io.convert import WRITERS, convert

FILES = int(os.environ.get("TORCHTRACK_FUZZ", "300"))
LIBRARIES = {"aedat4": ("dv_processing", "lz4.frame"), "bag": ("rosbags",), "db3": ("rosbags",)}
KINDS = ("evt2", "evt3", "evt21", "dat", "es", "aedat4", "dsec", "sequence", "npz", "csv", "davis", "bag", "db3")


def original(kind: str, folder: Path, data_dir: Path) -> Path:
    """A small sound file of a format."""
    events = random_events(400, **SIZE)
    recordings = data_dir / "recordings"
    if kind in WRITERS and kind != "npz":
        path = folder / f"events{'.aedat4' if kind == 'aedat4' else '.bin'}"
        writer = WRITERS[kind](path, SIZE["width"], SIZE["height"])
        writer.write(events)
        writer.close()
        return path
    if kind == "npz":
        return save_npz(folder / "events.npz", events, compressed=True)
    if kind == "sequence":
        convert(write_tiny_sequence(folder, duration_us=5000), folder / "events.h5")
        return folder / "events.h5"
    if kind == "davis":
        rows = zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), strict=True)
        (folder / "events.txt").write_text("".join(f"0.{t:06d} {x} {y} 1\n" for t, x, y in rows))
        return folder / "events.txt"
    if kind == "evt21":
        words = np.array([8 << 60 | 1 << 32, *(1 << 60 | x << 43 | 7 << 32 | 255 for x in range(50))], "<u8")
        (folder / "events.raw").write_bytes(b"% evt 2.1\n% geometry 64x48\n% end\n" + words.tobytes())
        return folder / "events.raw"
    source = {
        "bag": "event_camera_msgs_evt3.bag",
        "db3": "event_camera_msgs_evt3_ros2/test_events_1.db3",
        "dat": "ncars_sample.dat",
        "es": "dvs_sample.es",
    }
    path = folder / Path(source[kind]).name
    shutil.copyfile(recordings / source[kind], path)
    # A bag is read through its index at the end; the others may be cut.
    if kind == "es":
        path.write_bytes(path.read_bytes()[:5000])
    return path


def mutated(content: np.ndarray, random: np.random.Generator) -> bytes:
    """Bytes changed, a stretch overwritten, cut out or doubled, or the end cut off."""
    way = random.integers(5)
    # The beginning and the end, where headers and tables are, are changed as often as all the rest.
    ends = [
        random.integers(0, min(600, len(content))),
        len(content) - 1 - random.integers(0, min(600, len(content))),
        random.integers(0, len(content)),
    ]
    at = int(ends[random.integers(3)])
    length = int(random.integers(1, 64))
    if way == 0:
        places = np.clip(at + random.integers(-100, 100, random.integers(1, 6)), 0, len(content) - 1)
        changed = content.copy()
        changed[places] = random.integers(0, 256, len(places))
        return changed.tobytes()
    if way == 1:
        return np.concatenate([content[:at], random.integers(0, 256, length).astype(np.uint8), content[at + length :]]).tobytes()
    if way == 2:
        return np.concatenate([content[:at], content[at + length :]]).tobytes()
    if way == 3:
        return np.concatenate([content[: at + length], content[at:]]).tobytes()
    return content[:at].tobytes()


def read(path: Path) -> None:
    source = open_events(path, **SIZE) if path.suffix in (".txt", ".npz", ".csv") else open_events(path)
    for chunk in source.chunks():
        assert int(chunk.x.max()) < source.width
        assert int(chunk.y.max()) < source.height
        assert bool((chunk.t_us[1:] >= chunk.t_us[:-1]).all())
    list(zip(range(2), source.seek(5000).chunks(), strict=False))
    if path.suffix == ".h5":
        read_sequence(path)


@pytest.mark.parametrize("kind", KINDS)
def test_changed_files_are_read_or_refused(tmp_path, data_dir, kind):
    for library in LIBRARIES.get(kind, ()):
        pytest.importorskip(library)
    path = original(kind, tmp_path, data_dir)
    read(path)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    random = np.random.default_rng(KINDS.index(kind))
    # Bags are large, and their library is slow.
    count = max(FILES // 60 if kind in ("bag", "db3") else -(-FILES // (len(KINDS) - 2)), 2)
    refused = 0
    for _ in range(count):
        path.write_bytes(mutated(content, random))
        with warnings.catch_warnings():
            # What was left out is told by warnings; that is what is wanted here.
            warnings.simplefilter("ignore")
            try:
                read(path)
            except TorchtrackError:
                refused += 1
    # Archives and bags have checksums and indices all over: nearly every change is found at once.
    assert refused < count or kind in ("npz", "sequence", "bag", "db3")

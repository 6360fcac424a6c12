"""Memory does not grow with the file. ``TORCHTRACK_LARGE=1`` reads a recording of 1 GB in each of five formats."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LARGE = bool(os.environ.get("TORCHTRACK_LARGE"))
# In a process of its own: the peak of a process never falls. What imports take is not what reading takes.
READER = """
import resource, sys
from torchtrack.io import open_events
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
count = sum(len(chunk) for chunk in open_events(sys.argv[1]).chunks())
print(count, before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
WRITER = """
import sys
from pathlib import Path
from torchtrack.bench.io import write_events
write_events(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
"""
# Bytes of an event as the writer writes it, about.
BYTES = {"evt3": 1.37, "evt2": 4, "dat": 8, "dsec": 13, "npz": 13}


def peak_megabytes(path: Path, kind: str, megabytes: int) -> tuple[float, float]:
    """What reading a file of this size adds to a process, and its peak in all (MB)."""
    count = int(megabytes * 1e6 / BYTES[kind])
    subprocess.run([sys.executable, "-c", WRITER, str(path), kind, str(count)], check=True)
    assert path.stat().st_size > 0.8e6 * megabytes
    printed = subprocess.run([sys.executable, "-c", READER, str(path)], check=True, capture_output=True, text=True).stdout
    read, before, peak = map(int, printed.split())
    assert read == count
    # Linux counts in KB, macOS in bytes.
    unit = 1e3 if sys.platform.startswith("linux") else 1e6
    return (peak - before) / unit, peak / unit


def test_reading_takes_little_memory(tmp_path):
    added, _ = peak_megabytes(tmp_path / "e.raw", "evt2", 20)
    assert added < 40


@pytest.mark.skipif(not LARGE, reason="reads 1 GB; set TORCHTRACK_LARGE=1")
@pytest.mark.parametrize(("kind", "suffix"), [("evt3", ".raw"), ("evt2", ".raw"), ("dat", ".dat"), ("dsec", ".h5"), ("npz", ".npz")])
def test_a_recording_of_one_gigabyte(tmp_path, kind, suffix):
    added, peak = peak_megabytes(tmp_path / f"e{suffix}", kind, 1000)
    print(f"{kind}: {added:.0f} MB for reading, {peak:.0f} MB in all")
    assert peak < 300

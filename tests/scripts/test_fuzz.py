"""The short form of scripts/fuzz; ``TORCHTRACK_FUZZ=10000`` makes it the long one."""

import os
import re
import subprocess
import sys

import pytest
from places import REPOSITORY


def test_damaged_files_give_results_or_clear_errors():
    for library in ("rosbags", "lz4.frame", "zstandard", "dv_processing"):
        pytest.importorskip(library)
    count = int(os.environ.get("TORCHTRACK_FUZZ", "300"))
    command = [sys.executable, REPOSITORY / "scripts" / "fuzzing", "--count", str(count), "--jobs", "2", "--no-hostile"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    results, errors = (int(re.search(rf"(\d+) {kind}", done.stdout)[1]) for kind in ("result", "clear error"))
    assert results + errors >= count and results > 50 and errors > 50

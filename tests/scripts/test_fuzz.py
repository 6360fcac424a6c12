"""The short form of scripts/fuzz; ``TORCHTRACK_FUZZ=10000`` makes it the long one."""

import os
import re
import subprocess
import sys

import pytest
from places import REPOSITORY

# Damaged files of these are read as far as they go. Archives and bags have checksums and indices all over: most changes are found at once.
READ_AS_FAR_AS_THEY_GO = ("evt2", "evt3", "evt21", "dat", "es_dvs", "es_atis", "aedat4_plain", "dsec", "csv", "davis_text")


def test_damaged_files_give_results_or_clear_errors():
    for library in ("rosbags", "lz4.frame", "zstandard", "dv_processing"):
        pytest.importorskip(library)
    count = int(os.environ.get("TORCHTRACK_FUZZ", "300"))
    command = [sys.executable, REPOSITORY / "scripts" / "fuzzing", "--count", str(count), "--jobs", "2", "--no-hostile", "--each"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    results, errors = (int(re.search(rf"(\d+) {kind}", done.stdout)[1]) for kind in ("result", "clear error"))
    assert results + errors >= count and results > 50 and errors > 50
    read = {name: int(number) for name, number in re.findall(r"^(\w+): (\d+) of \d+ were read$", done.stdout, re.MULTILINE)}
    assert [name for name in READ_AS_FAR_AS_THEY_GO if read[name] == 0] == []

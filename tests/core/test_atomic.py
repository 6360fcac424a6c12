"""Where files are written, and what if they cannot be."""

import os
import resource
import subprocess
import sys

import numpy as np
import pytest
from places import REPOSITORY

from torchtrack.core.atomic import atomic_path, check_other_file, check_writable
from torchtrack.errors import EventDataError, OutputError
from torchtrack.io.convert import WRITERS, convert
from torchtrack.io.line_file import LineFile


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
    with pytest.raises(OutputError, match=r"a\.txt': No space left on device"), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "whole"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_an_error_of_ours_stays_what_it_is(tmp_path):
    with pytest.raises(EventDataError, match="unsorted"), atomic_path(tmp_path / "a"):
        raise EventDataError("unsorted")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("folder", "folder': it is a folder"),
        ("pipe", "pipe': it is a device or a pipe"),
        ("file/below/a", "file' is a file, where a folder should be"),
        ("x" * 300, "name too long"),
    ],
)
def test_what_cannot_be_written_is_told_and_nothing_is_left(tmp_path, name, expected):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    os.mkfifo(tmp_path / "pipe")
    for attempt in (check_writable, lambda path: atomic_path(path).__enter__()):
        with pytest.raises(OutputError, match=expected):
            attempt(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "pipe"]


def test_a_trial_leaves_nothing(tmp_path):
    check_writable(tmp_path / "new" / "deep" / ("x" * 250))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only(tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        check_writable(tmp_path / "locked" / "a")


def test_the_file_that_is_read_is_not_written(tmp_path):
    events = {"t": np.arange(5), "x": np.zeros(5, np.uint16), "y": np.zeros(5, np.uint16), "p": np.ones(5, np.uint8)}
    np.savez(tmp_path / "a.npz", **events, width=4, height=3)
    (tmp_path / "link.npz").symlink_to("a.npz")
    os.link(tmp_path / "a.npz", tmp_path / "hard.npz")
    before = (tmp_path / "a.npz").read_bytes()
    for target in ("a.npz", "link.npz", "hard.npz", f"../{tmp_path.name}/a.npz"):
        with pytest.raises(OutputError, match="it is the file that is read"):
            convert(tmp_path / "a.npz", tmp_path / target)
    assert (tmp_path / "a.npz").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "hard.npz", "link.npz"]
    check_other_file(tmp_path / "a.npz", tmp_path / "none.npz")


def test_lines_stay_whole_when_a_write_fails(tmp_path, monkeypatch):
    file = LineFile(tmp_path / "lines")
    file.write("one\n")

    calls = []

    def part_of(file, data):
        calls.append(data)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")
        return file.write(data[:7])

    monkeypatch.setattr("torchtrack.io.line_file._write", part_of)
    with pytest.raises(OutputError, match="lines': No space left"):
        file.write("two\nthree\nfour\n")
    file.close()
    assert (tmp_path / "lines").read_bytes() == b"one\ntwo\n"
    monkeypatch.undo()
    again = LineFile(tmp_path / "lines")
    again.write("three\n")
    again.close()
    assert (tmp_path / "lines").read_bytes() == b"one\ntwo\nthree\n"


# Writes events in every format under a limit of file size, which fails as a full disk does.
_LIMITED = """
import sys
import numpy as np
from torchtrack.errors import OutputError
from torchtrack.io.convert import convert
for suffix in ("h5", "npz", "csv", "raw"):
    try:
        convert(sys.argv[1], f"{sys.argv[2]}/events.{suffix}")
    except OutputError as error:
        print(suffix, error)
"""


def test_no_format_ends_the_process_on_a_full_disk(tmp_path):
    count = 100_000
    columns = {"t": np.arange(count), "x": np.zeros(count, np.uint16), "y": np.zeros(count, np.uint16), "p": np.ones(count, np.uint8)}
    np.savez(tmp_path / "a.npz", **columns, width=4, height=3)

    def limit():
        # Python ignores SIGXFSZ: a write beyond the limit is an error.
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    command = [sys.executable, "-W", "error", "-c", _LIMITED, str(tmp_path / "a.npz"), str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120, preexec_fn=limit)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{suffix} cannot write to '{tmp_path}/out/events.{suffix}': File too large." for suffix in ("h5", "npz", "csv", "raw")
    ]
    assert list((tmp_path / "out").iterdir()) == []


def test_aedat4_needs_room_to_close_its_file(tmp_path, monkeypatch):
    pytest.importorskip("dv_processing", reason="needs dv-processing: pip install 'torchtrack[aedat]'")
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1 << 20}))
    with pytest.raises(OSError, match="No space left on device.*16 MB to spare"):
        WRITERS["aedat4"](tmp_path / "a.aedat4", 4, 3)

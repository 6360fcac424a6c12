"""The output folder of a run: filled beside its place, then put there file by file."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def output_folder(output: Path, replaces: Sequence[str]) -> Iterator[Path]:
    """A folder to write into; its files move to ``output`` when the block ends without an error.

    On an error nothing is left behind and ``output`` is as it was.

    Args:
        output: where the files go; made when it is not there.
        replaces: patterns of files that an earlier run may have left in ``output``; they go when the new ones come,
            so that the folder never mixes two runs.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as folder:
        yield Path(folder)
        output.mkdir(exist_ok=True)
        for stale in {path for pattern in replaces for path in output.glob(pattern)}:
            stale.unlink()
        for path in sorted(Path(folder).iterdir()):
            os.replace(path, output / path.name)

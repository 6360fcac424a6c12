"""Text between two marks in a Markdown file: ``<!-- NAME -->`` and ``<!-- /NAME -->``, each on a line of its own."""

import re
import textwrap
from pathlib import Path

from torchtrack.core.atomic import atomic_path
from torchtrack.errors import ConfigError, MissingFileError

_WIDTH = 120


def check_marks(path: Path, name: str) -> None:
    """See whether a file has both marks.

    Raises:
        MissingFileError: if there is no such file.
        ConfigError: if it has not each mark once, in order.
    """
    _parts(path, name)


def replace_between(path: Path, name: str, text: str) -> None:
    """Put ``text`` in place of what stands between the marks; its lines are wrapped, but for rows of tables.

    Raises:
        MissingFileError, ConfigError: as :func:`check_marks`.
        OutputError: if the file cannot be written.
    """
    before, after = _parts(path, name)
    lines = [line if line.startswith("|") else textwrap.fill(line, _WIDTH) for line in text.strip().splitlines()]
    with atomic_path(path) as new:
        new.write_text(before + "\n".join(lines) + "\n" + after, encoding="utf-8")


def _parts(path: Path, name: str) -> tuple[str, str]:
    """What stands up to the first mark, and from the second on."""
    if not path.is_file():
        raise MissingFileError(f"table: no file at {path}. Check the path.")
    pattern = rf"(.*^<!-- {re.escape(name)} -->\n)(?:.*\n)?(^<!-- /{re.escape(name)} -->$.*)"
    text = path.read_text(encoding="utf-8")
    marked = re.fullmatch(pattern, text, re.MULTILINE | re.DOTALL)
    if marked is None or text.count(f"<!-- {name} -->") != 1 or text.count(f"<!-- /{name} -->") != 1:
        raise ConfigError(f"table: '{path}' needs the lines '<!-- {name} -->' and '<!-- /{name} -->', once each: the table comes between them.")
    return marked[1], marked[2]

"""Names say what they name: words that fit anything are names of nothing.

``found`` may be a match, a pose or a file; the name is ``match``, ``pose`` or ``path``.
"""

import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
BANNED = frozenset({"told", "found", "of", "beside", "little", "one"})


def banned_names(path: Path) -> Iterator[str]:
    """``file:line: name`` of each identifier in a file that is a banned word."""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.NAME and token.string in BANNED:
                yield f"{path}:{token.start[0]}: {token.string}"


def python_files(folder: str) -> list[Path]:
    files = sorted((REPOSITORY / folder).rglob("*.py"))
    assert files, f"no Python file in {folder}"
    return files


@pytest.mark.parametrize("folder", ["torchtrack", "tests", "scripts"])
def test_no_name_is_a_banned_word(folder):
    assert [name for path in python_files(folder) for name in banned_names(path)] == []


def test_attributes_and_parameters_count_and_strings_do_not(tmp_path):
    path = tmp_path / "names.py"
    path.write_text('def f(told):\n    return told.of("found one")\n')
    assert list(banned_names(path)) == [f"{path}:1: told", f"{path}:2: told", f"{path}:2: of"]

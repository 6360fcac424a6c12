"""Docstrings name what they explain: every name under ``Args:`` is an argument of the function, or a field of the class."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "torchtrack"
ENTRY = re.compile(r"^ {4}(?P<names>\w+(?:, \w+)*):(?: |$)", re.MULTILINE)


def documented(tree: ast.Module) -> Iterator[ast.ClassDef | ast.FunctionDef]:
    """All classes and functions of a file."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef))


def explained(node: ast.ClassDef | ast.FunctionDef) -> list[str]:
    """Names under ``Args:``."""
    _, _, entries = (ast.get_docstring(node) or "").partition("Args:\n")
    return [name for entry in ENTRY.finditer(entries.split("\n\n")[0]) for name in entry["names"].split(", ")]


def arguments(function: ast.FunctionDef) -> set[str]:
    """Names of all arguments of a function."""
    given = function.args
    starred = [argument for argument in (given.vararg, given.kwarg) if argument is not None]
    return {argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs, *starred)}


def fields(kind: ast.ClassDef, classes: list[ast.ClassDef]) -> set[str]:
    """Names of a class's fields and of what it is made from, with those of the classes it extends."""
    own = {node.target.id for node in kind.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)}
    made = [arguments(node) for node in kind.body if isinstance(node, ast.FunctionDef) and node.name in ("__init__", "__new__")]
    bases = {base.id for base in kind.bases if isinstance(base, ast.Name)} - {kind.name}
    return own.union(*made, *(fields(other, classes) for other in classes if other.name in bases))


def strangers(trees: dict[str, ast.Module]) -> Iterator[str]:
    """``file:line: name`` of each name that a docstring explains and its function or class does not have."""
    classes = [node for tree in trees.values() for node in documented(tree) if isinstance(node, ast.ClassDef)]
    for path, tree in trees.items():
        for node in documented(tree):
            if names := explained(node):
                known = fields(node, classes) if isinstance(node, ast.ClassDef) else arguments(node)
                yield from (f"{path}:{node.lineno}: {name}" for name in names if name not in known)


def test_docstrings_explain_what_is_there():
    trees = {str(path.relative_to(PACKAGE)): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    assert sum(len(explained(node)) for tree in trees.values() for node in documented(tree)) > 1000
    assert list(strangers(trees)) == []


def test_an_old_name_is_noticed():
    text = 'class A:\n    a: int\n\nclass B(A):\n    """B.\n\n    Args:\n        a, old: first.\n        b: second.\n    """\n    b: int\n'
    assert list(strangers({"b.py": ast.parse(text)})) == ["b.py:4: old"]

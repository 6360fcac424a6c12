"""Imports run one way: the order of the rooms is written here once, and every import of the package is held against it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "torchtrack"
# From left to right: a module imports only from rooms on its left, and from its own.
ORDER = (
    ("errors",),
    ("core",),
    ("config",),
    ("object_model", "io"),
    ("tracking.contours",),
    ("tracking.motion",),
    ("tracking.frontend",),
    ("tracking.association",),
    ("tracking.estimation",),
    ("tracking.validation",),
    ("tracking.adaptation",),
    ("tracking.state",),
    ("tracking.relocalization",),
    ("tracking.adapt", "tracking.update", "tracking.objects"),
    ("tracking.initialization", "tracking.start_check", "tracking.step_check"),
    ("tracking.expectation",),
    ("tracking.step",),
    ("tracking.deferred_search",),
    ("tracking.cuda_graphs", "tracking.compiling"),
    ("tracking.graphs",),
    ("tracking.tracker",),
    ("backends", "baselines", "viz"),
    ("run",),
    ("sim",),
    ("learn", "eval"),
    ("report",),
    ("bench",),
    ("cli",),
    ("__main__",),
)
# A function that needs more is two, or its arguments are one thing without a name. These have a user's options, most of them left out.
MOST_ARGUMENTS = 6
OF_USERS = {"tracking.tracker.__init__", "viz.overlay.overlay_objects", "viz.overlay.draw_overlay", "cli.simulate.simulate", "cli.track.track_many"}
PLACES = {name: place for place, names in enumerate(ORDER) for name in names}


def room_of(module: str) -> str:
    """The name in ORDER that a module belongs to."""
    return next((name for name in PLACES if module == name or module.startswith(f"{name}.")), module)


def modules() -> dict[str, ast.Module]:
    """Every module by its name within the package, and what stands in it."""
    parsed = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        parsed[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text(encoding="utf-8"))
    return parsed


MODULES = modules()


def imports(module: str) -> Iterator[tuple[str, int]]:
    """Modules of the package that a module imports, wherever in it, with the line."""
    for node in ast.walk(MODULES[module]):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torchtrack":
            base = (node.module or "").partition(".")[2]
            for alias in node.names:
                inner = f"{base}.{alias.name}".lstrip(".")
                yield inner if inner in MODULES else base, node.lineno
        elif isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[2], node.lineno) for alias in node.names if alias.name.startswith("torchtrack."))


@pytest.mark.parametrize("module", [name for name in MODULES if name and room_of(name) != "tracking"])
def test_imports_run_one_way(module):
    own = room_of(module)
    assert own in PLACES, f"'{module}' has no place in the order of the rooms"
    for imported, line in imports(module):
        room = room_of(imported)
        assert room in (own, "") or PLACES[room] < PLACES[own], f"{module}, line {line}: imports {imported}, which is not on the left of {own}"


def test_nobody_imports_the_backend():
    """It registers itself where the seam loads it; the simulator's kernels are compiled as the backend's are."""
    users = {module for module in MODULES for imported, _ in imports(module) if room_of(imported) == "backends" and room_of(module) != "backends"}
    assert {user.split(".")[0] for user in users} <= {"sim", "bench"}


def functions(module: str) -> Iterator[tuple[str, int]]:
    """Functions and methods of a module by their names, and how many arguments they take beside their own object."""
    for node in ast.walk(MODULES[module]):
        if isinstance(node, ast.FunctionDef):
            names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            yield f"{module}.{node.name}", len(names) - (names[:1] in (["self"], ["cls"]))


def test_no_function_takes_too_many_arguments():
    # A launch of Triton's takes pointers and sizes, each by itself.
    taken = {name: count for module in MODULES if not module.startswith("backends.triton.") for name, count in functions(module)}
    assert len(taken) > 2000
    assert {name for name, count in taken.items() if count > MOST_ARGUMENTS} == OF_USERS


def test_no_module_is_imported_in_a_circle():
    waiting = {module: {imported for imported, _ in imports(module) if imported != module} & MODULES.keys() for module in MODULES}
    while free := [module for module, needed in waiting.items() if not needed]:
        for module in free:
            del waiting[module]
        for needed in waiting.values():
            needed.difference_update(free)
    assert not waiting, f"in circles, or behind one: {sorted(waiting)}"

"""The Dockerfile copies what is there, installs what pyproject names, and runs without root. Docker itself is not needed."""

import re
import tomllib
from fnmatch import fnmatch

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from places import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
IGNORED = (REPOSITORY / ".dockerignore").read_text().splitlines()


def instructions():
    """Name and rest of each instruction, with continued lines joined."""
    text = re.sub(r"^#.*\n", "", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]


def values(name):
    return [rest for instruction, rest in instructions() if instruction == name]


def in_context(path):
    """Whether a file or folder is sent to the builder: the last line of .dockerignore that fits decides."""
    sent = True
    for line in IGNORED:
        if line and not line.startswith("#") and fnmatch(path, line.removeprefix("!")):
            sent = line.startswith("!")
    return sent


def test_instructions_are_dockers():
    assert {name for name, _ in instructions()} == {"FROM", "WORKDIR", "COPY", "RUN", "ENV", "USER", "ENTRYPOINT", "CMD"}


def test_what_is_copied_is_there_and_sent():
    sources = [path for rest in values("COPY") if not rest.startswith("--from") for path in rest.split()[:-1]]
    assert {"pyproject.toml", "torchtrack"} <= set(sources)
    for path in sources:
        assert (REPOSITORY / path).exists() and in_context(path), path
    # What a build of the package reads.
    assert {PROJECT["readme"], *PROJECT["license-files"]} <= set(sources)


@pytest.mark.parametrize("path", [".git", ".venv", "outputs", "tests", "docs"])
def test_all_else_is_not_sent(path):
    assert not in_context(path)


def test_what_is_installed_is_in_pyproject():
    (line,) = [rest for rest in values("RUN") if "pip install" in rest]
    extras = re.search(r"'\.\[([\w,]+)\]'", line)[1].split(",")
    assert "fast" in extras and set(extras) <= set(PROJECT["optional-dependencies"])
    assert "-c constraints.txt" in line and "https://download.pytorch.org/whl/cpu" in line
    pinned = map(Requirement, (line for line in (REPOSITORY / "constraints.txt").read_text().splitlines() if "==" in line))
    pins = {pin.name: pin.specifier for pin in pinned if pin.name in ("torch", "numba")}
    for requirement in map(Requirement, [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["fast"]]):
        if requirement.name in pins:
            (pin,) = pins[requirement.name]
            assert pin.version in requirement.specifier
    assert set(pins) == {"torch", "numba"}


def test_python_is_one_that_the_package_takes():
    versions = {re.match(r"python:(\d+\.\d+)-slim", rest)[1] for rest in values("FROM")}
    assert len(versions) == 1 and versions.pop() in SpecifierSet(PROJECT["requires-python"])


def test_it_runs_the_command_without_root():
    names = [name for name, _ in instructions()]
    assert values("USER") == ["torchtrack"] and "--create-home torchtrack" in "".join(values("RUN"))
    assert names.index("USER") < names.index("ENTRYPOINT") and values("ENTRYPOINT") == ['["torchtrack"]']
    assert "torchtrack" in PROJECT["scripts"]


def test_caches_are_where_anybody_may_write():
    (environment,) = values("ENV")
    home = re.search(r"HOME=(\S+)", environment)[1]
    assert f"chmod 0777 {home}" in "".join(values("RUN"))
    for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        assert re.search(rf"{name}={home}/\w+", environment), name


def test_how_to_build_and_run_it_is_said():
    text = (REPOSITORY / "Dockerfile").read_text()
    assert re.search(r"^#   docker build -t torchtrack \.$", text, re.MULTILINE)
    assert re.search(r"^#   docker run --rm .*-v \"\$PWD:/data\" .* torchtrack demo$", text, re.MULTILINE)

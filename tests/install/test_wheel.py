"""What pip installs is whole: a wheel built from the sdist, without a network, and used outside of the repository."""

import importlib.metadata
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
from packaging.metadata import Metadata
from packaging.requirements import Requirement
from packaging.version import Version
from places import REPOSITORY

import torchtrack

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
NOT_COPIED = (".*", "outputs", "build", "dist", "*.egg-info", "__pycache__")
PRESETS = ("default", "causal", "learned", "paper", "line", "ls", "nns")

pytestmark = pytest.mark.skipif(
    Version(importlib.metadata.version("setuptools")) < Version("77"), reason="needs setuptools 77 or later: pip install -U setuptools"
)


def run_python(*arguments, cwd, **options):
    done = subprocess.run([sys.executable, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """The sdist of a copy of the tree: a build leaves files behind."""
    folder = tmp_path_factory.mktemp("sdist")
    shutil.copytree(REPOSITORY, folder / "tree", ignore=shutil.ignore_patterns(*NOT_COPIED))
    run_python("-c", "from setuptools import build_meta; build_meta.build_sdist('..')", cwd=folder / "tree")
    (path,) = folder.glob("*.tar.gz")
    return path


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """The wheel that pip makes of the sdist."""
    folder = tmp_path_factory.mktemp("wheel")
    run_python("-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index", "-w", folder, sdist, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """What the wheel installs, unpacked; and a folder to work in."""
    site = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site, tmp_path_factory.mktemp("elsewhere")


def run_installed(installed, *arguments):
    site, cwd = installed
    return run_python(*arguments, cwd=cwd, env={"PYTHONPATH": str(site), "OMP_NUM_THREADS": "1", "PATH": ""})


def test_wheel_has_all_of_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    folder = REPOSITORY / "torchtrack"
    files = [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert names == {str(path.relative_to(REPOSITORY)) for path in files}
    assert {"torchtrack/py.typed", "torchtrack/scenes/demo.yaml", "torchtrack/weights/learned.safetensors", "torchtrack/report/page.html"} <= names
    assert wheel.stat().st_size < 2_000_000


def test_sdist_has_tests_and_documentation(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    files = ("CHANGELOG.md", "CITATION.cff", "Dockerfile", "LICENSE", "constraints.txt", "docs/index.md", "docs/notebooks/learning.ipynb")
    assert {*files, "tests/conftest.py", "tests/support/places.py", "scripts/demo", "configs/demo.yaml"} <= names
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]
    assert sdist.stat().st_size < 3_000_000


def test_metadata_is_what_the_project_says(wheel):
    with zipfile.ZipFile(wheel) as archive:
        prefix = f"torchtrack-{torchtrack.__version__}.dist-info"
        text = archive.read(f"{prefix}/METADATA").decode()
        licence, entries = archive.read(f"{prefix}/licenses/LICENSE").decode(), archive.read(f"{prefix}/entry_points.txt").decode()
    metadata = Metadata.from_email(text, validate=True)
    assert (metadata.name, str(metadata.version), metadata.license_expression) == ("torchtrack", torchtrack.__version__, "Apache-2.0")
    assert metadata.description_content_type == "text/markdown"
    assert metadata.description.strip() == (REPOSITORY / "README.md").read_text().strip()
    assert metadata.project_urls == PROJECT["urls"] and metadata.classifiers == PROJECT["classifiers"]
    assert not [line for line in metadata.classifiers if line.startswith("License ::")], "the licence is an expression"
    assert str(metadata.requires_python) == PROJECT["requires-python"]
    assert set(metadata.provides_extra) == set(PROJECT["optional-dependencies"])
    assert {Requirement(line).name for line in HeaderParser().parsestr(text).get_all("Requires-Dist") if "extra ==" not in line} == {
        Requirement(line).name for line in PROJECT["dependencies"]
    }
    assert licence == (REPOSITORY / "LICENSE").read_text()
    assert "torchtrack = torchtrack.cli.main:main" in entries


def test_every_extra_has_lower_bounds():
    lines = [*PROJECT["dependencies"], *(line for extra in PROJECT["optional-dependencies"].values() for line in extra)]
    assert [line for line in lines if [bound.operator for bound in Requirement(line).specifier] != [">="]] == []


def test_installed_package_has_what_its_first_steps_need(installed):
    """Version, settings, a model, all presets, weights and the scene of the demo, from a folder that has none of it."""
    site, _ = installed
    code = f"""
import sys
from torchtrack.cli.main import main
assert main(["--version"]) == 0 and not {{"torch", "numpy"}} & set(sys.modules)
assert main(["settings", "demo", "--markdown"]) == 0
import torch
import torchtrack
from torchtrack.config.demo import DemoConfig
from torchtrack.config.load import load
from torchtrack.eval.paper import paper_tables
from torchtrack.sim import SceneConfig
from torchtrack.tracking.association.weighting_network import TrustNetwork
scene = load(SceneConfig, DemoConfig().scene)
(cube,) = scene.objects[0].build()
cube.export("cube.stl")
assert main(["model", "cube.stl", "--unit", "m"]) == 0
for name in {PRESETS}:
    torchtrack.Tracker([torchtrack.ObjectModel.from_file("cube.stl")], scene.camera.build(), torchtrack.preset(name))
print(TrustNetwork.shipped(), [obj.label for obj in scene.objects], torchtrack.__file__, sep="\\n")
"""
    output = run_installed(installed, "-W", "error", "-c", code)
    assert output.startswith(f"torchtrack {torchtrack.__version__}\n") and "['cube', 'lbracket']" in output
    assert Path(output.splitlines()[-1]).is_relative_to(site)

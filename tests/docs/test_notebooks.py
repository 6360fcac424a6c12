"""The notebooks run from top to bottom, are kept without outputs, and can be found."""

import os
import re

import nbformat
import pytest
from nbclient import NotebookClient
from places import REPOSITORY

FOLDER = REPOSITORY / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def read(path):
    return nbformat.read(path, as_version=4)


def of_type(notebook, name):
    return [cell for cell in notebook.cells if cell.cell_type == name]


def printed(notebook):
    """What the cells print, without what they show."""
    return "".join(output.text for cell in of_type(notebook, "code") for output in cell.outputs if output.output_type == "stream")


def pictures(notebook):
    return [output for cell in of_type(notebook, "code") for output in cell.outputs if "image/png" in output.get("data", {})]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Both notebooks, run in an empty folder by this Python."""
    environment = {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1", "IPYTHONDIR": str(tmp_path_factory.mktemp("ipython"))}

    def run(name):
        notebook, folder = read(FOLDER / name), tmp_path_factory.mktemp("notebook")
        resources = {"metadata": {"path": str(folder)}}
        client = NotebookClient(notebook, kernel_name="python3", timeout=300, startup_timeout=300, resources=resources)
        # Pictures come into the notebook, whatever else this process draws with.
        client.execute(env={name: value for name, value in {**os.environ, **environment}.items() if name != "MPLBACKEND"})
        return notebook

    return run


def test_there_are_two():
    assert [path.name for path in NOTEBOOKS] == ["learning.ipynb", "own_object.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_they_are_kept_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    for cell in of_type(notebook, "code"):
        assert cell.outputs == [] and cell.execution_count is None, "strip the outputs: jupyter nbconvert --clear-output --inplace"
    assert set(notebook.metadata) <= {"kernelspec", "language_info"} and set(notebook.metadata.language_info) == {"name"}
    assert path.stat().st_size < 20_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_lead_somewhere_and_the_index_has_one(path):
    text = "\n".join(cell.source for cell in of_type(read(path), "markdown"))
    targets = re.findall(r"\]\(([^)#]+)", text)
    assert targets and [target for target in targets if not (FOLDER / target).exists()] == []
    assert f"(notebooks/{path.name})" in (REPOSITORY / "docs" / "index.md").read_text()
    for named in re.findall(r"`((?:scripts|configs)/[\w./]+)`", text):
        assert (REPOSITORY / named).exists(), named
    assert max(len(line) for line in text.splitlines()) <= 120


def test_the_own_object_is_tracked_from_a_picked_pose(done):
    notebook = done("own_object.ipynb")
    text = printed(notebook)
    assert "initial_pose:" in text and len(pictures(notebook)) == 3
    rotation_deg, position_mm, windows = map(float, re.search(r"mean error ([\d.]+)° / ([\d.]+) mm in (\d+) windows", text).groups())
    assert rotation_deg < 0.5 and position_mm < 2 and windows == 26


def test_learning_calibrates_and_trains(done):
    notebook = done("learning.ipynb")
    lengths = [float(number) for number in re.findall(r"([\d.]+) (?:→|px,)", printed(notebook))]
    assert lengths[0] == 186 and abs(lengths[-1] - 200) < 0.5 and len(lengths) == 5
    losses = [float(number) for number in re.findall(r"^([\d.]+) mm$", printed(notebook), re.MULTILINE)]
    assert len(losses) == 2 and all(0 < loss < 20 for loss in losses)
    assert len(pictures(notebook)) == 1

"""The command ``model``: what it says, what it writes, and how it ends."""

import cv2
import pytest
import trimesh

from torchtrack.cli.main import main


@pytest.fixture
def box_path(tmp_path):
    trimesh.creation.box((100.0, 80.0, 60.0)).apply_translation((50.0, 0, 0)).export(tmp_path / "box.stl")
    return tmp_path / "box.stl"


def command(*arguments):
    return main(["model", *(str(argument) for argument in arguments)])


def test_it_says_what_a_mesh_is(box_path, capsys):
    assert command(box_path) == 0
    output = capsys.readouterr().out
    for text in (
        "100 x 80 x 60 in the file's numbers",
        "in mm: 0.1414 m across  <-",
        "in m: 141.4 m across  (no tracked object)",
        "mm is the likeliest (the file does not say it); possible: cm, inch",
        "(50, 0, 0), 0.35 diameters from the file's origin; centre: true",
        "12 on 8 vertices",
        "12 creases",
        "mirrored across (1.00, 0.00, 0.00), (0.00, 1.00, 0.00), (0.00, 0.00, 1.00)",
    ):
        assert text in output


def test_options_place_the_model_and_the_picture_is_written(box_path, tmp_path, capsys):
    picture = tmp_path / "out" / "box.png"
    assert command(box_path, "--unit", "cm", "--scale", 0.1, "--centre", "-o", picture) == 0
    output = capsys.readouterr().out
    assert "enlarged by 0.1" in output and "in cm: 0.1414 m across  <-" in output and "it is the origin now" in output
    assert f"six views are in {picture}" in output
    assert cv2.imread(str(picture)).shape == (834, 1200, 3)


def test_notes_are_what_a_run_would_warn_of(tmp_path, capsys):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh.invert()
    mesh.export(tmp_path / "inside_out.ply")
    assert command(tmp_path / "inside_out.ply") == 0
    output = capsys.readouterr().out
    assert "12 faces were flipped" in output
    assert "note: 12 of 12 faces of 'inside_out' point inwards" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.ply",), "does not exist"),
        (("box.stl", "--unit", "m"), "141 m across with unit='m'"),
        (("box.stl", "-o", "box.jpg"), "pictures are .png files"),
        (("box.stl", "--scale", "0"), "give a scale that is a positive number"),
    ],
)
def test_what_is_wrong_is_one_line(box_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(box_path.parent)
    assert command(*arguments) == 1
    shown = capsys.readouterr().err
    assert message in " ".join(shown.split())
    assert "Traceback" not in shown
    assert not (box_path.parent / "box.jpg").exists()

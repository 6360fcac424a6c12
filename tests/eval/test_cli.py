"""``torchtrack evaluate`` with the reports, from the command line."""

import trimesh
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.main import main


def write_ball(folder):
    path = write_tiny_sequence(folder, "tiny", labels=("ball",), duration_us=12_000)
    trimesh.creation.icosphere(subdivisions=3, radius=0.06).export(folder / "tiny_ball.ply")
    return path


def test_methods_by_name_and_a_curved_object(tmp_path, capsys):
    arguments = ["evaluate", str(write_ball(tmp_path)), "--methods", "line,ls", "--jobs", "1", "--quiet", "-o", str(tmp_path / "out")]
    assert main([*arguments, "--report", "compact"]) == 0
    output = capsys.readouterr().out
    assert "- line: 'ball' is curved: 0 % of its contour is on straight edges, 50 % are needed" in output
    assert "- ls: 'ball' is curved" in output
    assert "| method | tiny |" in output and (tmp_path / "out" / "tables.md").is_file()


def test_the_papers_tables_are_printed_and_written(tmp_path, capsys):
    write_ball(tmp_path)
    path = tmp_path / "tables.yaml"
    path.write_text("report: paper\njobs: 1\noutput: out\nmethods: {line: {preset: line}, nns: {preset: nns}}\ncells: {'17': {source: tiny.npz}}\n")
    assert main(["evaluate", "--config", str(path), "--quiet"]) == 0
    output = capsys.readouterr().out
    assert output.count("**Table ") == 5
    rows = [[entry.strip() for entry in row.split("|")[1:-1]] for row in output.splitlines() if row.startswith("| line ")]
    assert ["line", *[""] * 8, "-", "-"] in rows
    assert (tmp_path / "out" / "tables.tex").read_text().count(r"\begin{table*}") == 6


def test_a_cell_that_the_paper_does_not_have(tmp_path, capsys):
    path = tmp_path / "tables.yaml"
    path.write_text("report: paper\ncells: {'01 normal': {source: a.npz}}\n")
    assert main(["evaluate", "--config", str(path), "--quiet"]) == 2
    assert "no '01 normal'" in capsys.readouterr().err


def test_a_trial_by_its_options(tmp_path, capsys):
    path, marked = write_tiny_sequence(tmp_path, "tiny", duration_us=12_000), tmp_path / "results.md"
    marked.write_text("<!-- TRIAL -->\n<!-- /TRIAL -->\n")
    arguments = ["evaluate", str(path), "--methods", "causal,ls", "--jobs", "1", "--quiet", "-o", str(tmp_path / "out")]
    assert main([*arguments, "--report", "trial", "--runs", "2", "--table", str(marked)]) == 0
    output = capsys.readouterr().out
    assert "| left out | runs | δR (°)" in output and "Windows lost by kind of scene" in output
    assert "| ls " in marked.read_text()
    assert main([*arguments, "--report", "trial", "--measured-only"]) == 0
    assert "| ls       | 1 " in capsys.readouterr().out

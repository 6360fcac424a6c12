"""The report of runs: complete, self-contained, and shown by a browser."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from browser import open_page
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.config.run import RunConfig
from torchtrack.core.lie import hat
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.report import page, write_report
from torchtrack.report.finished import read_run
from torchtrack.run.runner import run
from torchtrack.run.sinks.poses import standard_deviations


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of the same objects with different settings."""
    folder = tmp_path_factory.mktemp("runs")
    path = write_tiny_sequence(folder, "two", labels=("left", "right"), duration_us=40_000)
    for preset in ("causal", "nns"):
        run(RunConfig(source=path, output=folder / preset, preset=preset, overlay={"stills": 2}))
    return folder / "causal", folder / "nns"


class Page(HTMLParser):
    """Elements of a page, in order, with the depth of those that are open."""

    VOID = frozenset({"meta", "link", "img", "br"})

    def __init__(self, text: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def count(self, tag, **attributes):
        return sum(name == tag and attributes.items() <= values.items() for name, values in self.elements)


def test_the_page_has_everything_and_fetches_nothing(runs, tmp_path):
    write_report(runs, tmp_path / "report.html")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    text = (tmp_path / "report.html").read_text()
    parsed = Page(text)
    assert parsed.open == []
    assert parsed.count("figure", **{"class": "plot"}) == 6 and parsed.count("video") == 2 and parsed.count("img") == 4
    addresses = [values[name] for _, values in parsed.elements for name in ("src", "href", "xlink:href") if name in values]
    assert addresses and all(address.startswith(("data:", "#")) for address in addresses)
    for shown in ("left", "right", "TRACKING", "kornia", "machine.processor", "preset: nns", "mm</td>"):
        assert shown in text, shown
    # Of the settings, those that differ are in a table of their own.
    differences = text[text.index("Settings that differ") : text.index("<h2>Settings</h2>")]
    assert re.search(r"<th>preset</th><td>causal</td><td>nns</td>", differences) and "overlay.stills" not in differences


def test_a_browser_shows_every_figure(runs, tmp_path):
    write_report(runs, tmp_path / "report.html")
    with open_page() as shown:
        asked, faults = [], []
        shown.on("request", lambda request: asked.append(request.url))
        shown.on("pageerror", lambda error: faults.append(str(error)))
        shown.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        shown.goto((tmp_path / "report.html").as_uri())
        shown.wait_for_function("[...document.querySelectorAll('video')].every((video) => video.readyState >= 2 || video.error)")
        sizes = shown.evaluate("[...document.querySelectorAll('figure.plot svg')].map((svg) => [svg.clientWidth, svg.clientHeight])")
        # What a plot draws, and not its frame alone.
        drawn = shown.evaluate(
            """[...document.querySelectorAll('figure.plot svg')].map((svg) => [...svg.querySelectorAll('path')]
               .filter((path) => path.getBoundingClientRect().width > 50 && getComputedStyle(path).stroke != 'none').length)"""
        )
        images = shown.evaluate("[...document.querySelectorAll('img')].map((image) => image.complete ? image.naturalWidth : 0)")
        videos = shown.evaluate("[...document.querySelectorAll('video')].map((video) => video.error ? 0 : video.videoWidth)")
    assert faults == [] and all(url.startswith(("file:", "data:")) for url in asked)
    assert len(sizes) == 6 and all(width > 300 and height > 150 for width, height in sizes)
    assert len(drawn) == 6 and all(count >= 3 for count in drawn)
    assert images == [960] * 4 and videos == [960] * 2


def test_a_large_video_is_linked(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MOST_EMBEDDED_BYTES", 10)
    write_report(runs[:1], tmp_path / "report.html")
    (address,) = [values["src"] for tag, values in Page((tmp_path / "report.html").read_text()).elements if tag == "video"]
    assert (tmp_path / address).resolve() == (runs[0] / "overlay.mp4").resolve()


def test_names_and_messages_are_no_markup(runs, tmp_path):
    copied = tmp_path / "<b>bold"
    copied.mkdir()
    for name in ("summary.json", "config.yaml", "poses.csv"):
        (copied / name).write_bytes((runs[0] / name).read_bytes())
    write_report([copied], tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "<b>bold" not in text and "&lt;b&gt;bold" in text


def test_the_command(runs, tmp_path, capsys):
    assert main(["report", str(runs[0]), "-o", str(tmp_path / "page.html")]) == ExitCode.DONE
    assert "page.html" in capsys.readouterr().out and (tmp_path / "page.html").stat().st_size > 10_000
    assert main(["report", str(runs[0]), "-o", str(tmp_path / "page.pdf")]) == ExitCode.WRONG_SETTINGS
    assert "is an .html file" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "nowhere")]) == ExitCode.FAILED
    assert "is no output folder of a run" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("summary.json", "{", "cannot be read"),
        ("summary.json", "[]", "is no summary of a run"),
        ("poses.csv", "a,b\n1,2\n", "is no table of poses"),
        ("poses.csv", None, "poses.csv is not there"),
    ],
)
def test_folders_that_are_no_runs(runs, tmp_path: Path, name, content, message):
    for kept in ("summary.json", "config.yaml", "poses.csv"):
        (tmp_path / kept).write_bytes((runs[0] / kept).read_bytes())
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(content)
    with pytest.raises((MissingFileError, UnknownFormatError), match=message):
        write_report([tmp_path], tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def test_a_row_that_is_no_pose(runs, tmp_path):
    for kept in ("summary.json", "config.yaml", "poses.csv"):
        (tmp_path / kept).write_bytes((runs[0] / kept).read_bytes())
    text = (tmp_path / "poses.csv").read_text()
    (tmp_path / "poses.csv").write_text(text.replace("TRACKING", "SOMETHING", 1))
    with pytest.raises(UnknownFormatError, match="something else than poses: 'SOMETHING'"):
        read_run(tmp_path)
    # A last line that is not whole is left out.
    (tmp_path / "poses.csv").write_text(text + "123,le")
    assert len(read_run(tmp_path).tracks[0].t_us) == 8


def test_one_folder_twice(runs, tmp_path):
    with pytest.raises(ConfigError, match="each once"):
        write_report([runs[0], runs[0]], tmp_path / "report.html")


def test_standard_deviations_are_of_the_origin():
    """Against samples of the perturbation: the origin is moved by φ × t + ρ."""
    generator = torch.Generator().manual_seed(0)
    root = 1e-3 * torch.randn(1, 6, 6, dtype=torch.float64, generator=generator)
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, :3, 3] = torch.tensor([0.3, -0.2, 0.8])
    samples = torch.randn(200_000, 6, dtype=torch.float64, generator=generator) @ root[0].mT
    moved = -samples[:, :3] @ hat(T[0, :3, 3]).mT + samples[:, 3:]
    expected = [torch.rad2deg(samples[:, :3].pow(2).sum(-1).mean().sqrt()), 100 * moved.pow(2).sum(-1).mean().sqrt()]
    torch.testing.assert_close(standard_deviations(root @ root.mT, T)[0], torch.stack(expected), rtol=0.01, atol=0.0)

"""The page, in a real headless browser: a bracket is dragged and picked there, refined and saved, and the pose is right."""

import re
import socket
import threading
import time
import urllib.request

import numpy as np
import pytest
import torch
from browser import open_page
from moving_bracket import AT_US, error_deg, write_bracket
from solid_models import l_prism
from tiny_sequence import CAMERA

from torchtrack.cli.main import main
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.lie import transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.run.first_pose.by_hand import placed_before
from torchtrack.run.first_pose.clicks import Ray, clicked_point
from torchtrack.run.first_pose.page import angle_of_view
from torchtrack.run.first_pose.picks import FEWEST_PICKS
from torchtrack.run.first_pose.request import PoseFile
from torchtrack.run.first_pose.start import Start
from torchtrack.run.initial_pose import configured_pose
from torchtrack.run.session import open_session

pytest.importorskip("viser", reason="needs viser: pip install 'torchtrack[viz]'")


class Screen:
    """Where things of the camera's frame are on the page, which looks from where the camera is."""

    def __init__(self, page):
        box = page.locator("canvas").first.bounding_box()
        self.mouse, self.middle = page.mouse, (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.focal = box["height"] / 2 / torch.tan(torch.tensor(angle_of_view(CAMERA) / 2)).item()

    def at(self, point_cam):
        x, y, z = point_cam.tolist()
        return self.middle[0] + self.focal * x / z, self.middle[1] + self.focal * y / z

    def click(self, point_cam):
        self.mouse.click(*self.at(point_cam))

    def drag(self, start_cam, end_cam):
        self.mouse.move(*self.at(start_cam))
        self.mouse.down()
        self.mouse.move(*self.at(end_cam), steps=8)
        self.mouse.up()


def at(T, point):
    return transform_points(T, point[None])[0]


def seen_points(T):
    """Points of the bracket that the camera sees at a pose, near corners and far from each other."""
    model = ObjectModel.from_mesh(l_prism())
    triangles = model.triangles.double()
    points = (0.2 * triangles.mean(1, keepdim=True) + 0.8 * triangles).flatten(0, 1)
    points = torch.stack([point for point in points if is_seen(point, model, T)])
    chosen = [0]
    for _ in range(FEWEST_PICKS - 1):
        chosen.append(int(torch.cdist(points, points[chosen]).amin(1).argmax()))
    return points[chosen]


def is_seen(point, model, T):
    met = clicked_point(Ray(np.zeros(3), at(T, point).numpy()).in_object(T), model)
    return met is not None and np.linalg.norm(met - point.numpy()) < 1e-3


@pytest.fixture
def served(tmp_path):
    """The command, running beside the test; where its page is, and the file that it writes."""
    truth = write_bracket(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url, output, codes = f"http://127.0.0.1:{port}", tmp_path / "pose.yaml", []
    arguments = ["--mesh", tmp_path / "in_mm.stl", "--unit", "mm", "--at-us", AT_US, "--browser", "--port", port, "-o", output]
    command = threading.Thread(target=lambda: codes.append(main(["pose", *map(str, (tmp_path / "bracket.npz", *arguments))])), daemon=True)
    command.start()
    while command.is_alive() and not answers(url):
        time.sleep(0.1)
    return url, command, codes, output, truth


def answers(url):
    try:
        with urllib.request.urlopen(url):
            return True
    except OSError:
        return False


def first_placed(folder):
    source = {"source": str(folder / "bracket.npz"), "start_us": AT_US}
    return placed_before(Start.from_session(open_session(load(RunConfig, None, source))))


def translation(page):
    text = page.get_by_text("translation").text_content()
    return torch.tensor([float(word) for word in re.search(r"translation (\S+), (\S+), (\S+) m", text).groups()], dtype=torch.float64)


def test_a_pose_is_made_in_the_browser(served, tmp_path):
    url, command, codes, output, truth = served
    T = first_placed(tmp_path)
    with open_page(served=True) as page:
        page.goto(url)
        page.get_by_text("translation").wait_for()
        page.set_default_timeout(60_000)
        screen, middle = Screen(page), l_prism().bounds.mean(0)
        arrow = 0.3 * ObjectModel.from_mesh(l_prism()).diameter_m * torch.eye(3, dtype=torch.float64)[2]
        before, middle = translation(page), torch.from_numpy(middle)
        screen.drag(at(T, middle + arrow), at(T, middle + 1.6 * arrow))
        page.wait_for_function("before => !document.body.innerText.includes(before)", arg=", ".join(f"{value:.4g}" for value in before.tolist()))
        page.wait_for_timeout(500)
        T[:3, 3] = translation(page)
        assert torch.allclose(T[:3, 3] - before, 0.6 * T[:3, :3] @ arrow, atol=5e-3)

        page.get_by_text("Pick pairs of points").click()
        for number, point in enumerate(seen_points(T), 1):
            page.get_by_text("Click on a pixel").wait_for()
            screen.click(at(truth, point))
            page.get_by_text("Click on the point of the object").wait_for()
            screen.click(at(T, point))
            page.get_by_text(f"{number} pairs").wait_for()
        page.get_by_text("Refine").click()
        page.get_by_text("Events explain").wait_for()
        page.get_by_role("button", name="Save", exact=True).click()
        command.join(30)
    assert codes == [0]
    T = configured_pose(load(PoseFile, output).initial_pose, 0)
    assert error_deg(T, truth) < 3 and torch.allclose(T[:3, 3], truth[:3, 3], atol=0.02)

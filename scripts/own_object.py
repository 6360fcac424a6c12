#!/usr/bin/env python3
"""Walk through docs/own_object.md: write its files, run its commands as printed, and make its pictures of what came out.

    .venv/bin/python scripts/own_object.py outputs/own_object --pictures

Without ``--pictures`` nothing in docs/ is changed. The picture of the report needs Playwright (extra ``dev``) and Chromium.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "own_object.md"
IMAGES = REPOSITORY / "docs" / "images"
# Which picture shows what of the walk (the last of such files), and how wide it is made (px).
PICTURES = {
    "own_model": ("model.png", 800),
    "own_events": ("events.png", 700),
    "own_pose": ("pose.png", 700),
    "own_still": ("outputs/bracket/overlay_*.png", 700),
    "own_report": ("report.png", 700),
}
_QUALITY = 80


def walk(folder: Path, execute: Callable[[list[str]], None]) -> None:
    """Write the files of the page and run its commands, in their order.

    Args:
        folder: where the files are written.
        execute: runs one command, given as its words, in that folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for info, text in re.findall(r"^```(.+?)\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        _, _, name = info.partition(" file ")
        if name:
            (folder / name).write_text(text, encoding="utf-8")
        if info == "bash":
            for command in text.replace("\\\n", " ").splitlines():
                execute(shlex.split(command))


def run_in(folder: Path) -> Callable[[list[str]], None]:
    """Runs commands in a folder, as a user would; one that fails ends the walk."""
    # What is installed beside this Python, and no other.
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}

    def execute(words: list[str]) -> None:
        sys.stdout.write(f"$ {shlex.join(words)}\n")
        sys.stdout.flush()
        subprocess.run(words, cwd=folder, env=environment, check=True)

    return execute


def make_pictures(folder: Path) -> None:
    """Make the pictures of the page from the files of a walk."""
    _photograph(folder / "bracket.html", folder / "report.png")
    for name, (made, width) in PICTURES.items():
        image = cv2.imread(str(max(folder.glob(made))))
        if image is None:
            raise SystemExit(f"{made} is no picture")
        height = round(image.shape[0] * width / image.shape[1])
        smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(IMAGES / f"{name}.webp"), smaller, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])


def _photograph(page: Path, picture: Path) -> None:
    """What a browser shows of a page at first."""
    # Of the extra dev, and of no use without the pictures.
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        shown = browser.new_context(offline=True, viewport={"width": 1100, "height": 1000}).new_page()
        shown.goto(page.resolve().as_uri())
        shown.screenshot(path=str(picture))
        browser.close()


def main() -> None:
    """As the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", action="store_true", help="also write docs/images/own_*.webp")
    arguments = parser.parse_args()
    walk(arguments.folder, run_in(arguments.folder))
    if arguments.pictures:
        make_pictures(arguments.folder)


if __name__ == "__main__":
    main()

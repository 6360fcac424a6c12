"""``tests/pins/base`` names the commit whose digits hold; it moves only where a commit says that digits change."""

import re
import subprocess

import pytest
from places import REPOSITORY

PIN = "tests/pins/base"


def git(*arguments):
    done = subprocess.run(["git", "-C", str(REPOSITORY), *arguments], capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


@pytest.fixture(scope="module")
def history():
    """Commits that changed the pin, the newest first."""
    if git("rev-parse", "--is-shallow-repository") != "false":
        pytest.skip("not a clone with its whole history")
    return (git("log", "--format=%H", "--", PIN) or "").split()


def test_the_pin_is_the_full_name_of_a_commit():
    assert re.fullmatch(r"[0-9a-f]{40}\n", (REPOSITORY / PIN).read_text())


def test_the_pinned_commit_came_before_this_one(history):
    pinned = (REPOSITORY / PIN).read_text().strip()
    if git("cat-file", "-e", pinned) is None:
        pytest.skip(f"commit {pinned} is not in this clone")
    assert git("merge-base", "--is-ancestor", pinned, "HEAD") is not None


def test_the_pin_moved_last_in_a_commit_that_says_that_digits_change(history):
    if len(history) < 2:
        pytest.skip("the pin has not moved since it was set")
    message = git("log", "-1", "--format=%B", history[0])
    assert "Digits: change" in message.splitlines(), f"{history[0][:12]} moved {PIN} and does not say 'Digits: change' on a line of its own"

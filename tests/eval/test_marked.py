"""A table between two marks of a Markdown file."""

import pytest

from torchtrack.errors import ConfigError, MissingFileError
from torchtrack.eval.marked import check_marks, replace_between


def test_what_stands_between_the_marks_is_replaced_and_nothing_else(tmp_path):
    path = tmp_path / "results.md"
    path.write_text("# Results\n\n<!-- TRIAL -->\nold\n\nolder\n<!-- /TRIAL -->\n\nThe end.\n")
    replace_between(path, "TRIAL", "| new \\1 |\n")
    assert path.read_text() == "# Results\n\n<!-- TRIAL -->\n| new \\1 |\n<!-- /TRIAL -->\n\nThe end.\n"


def test_marks_with_nothing_between(tmp_path):
    path = tmp_path / "results.md"
    path.write_text("<!-- TRIAL -->\n<!-- /TRIAL -->")
    replace_between(path, "TRIAL", "new")
    assert path.read_text() == "<!-- TRIAL -->\nnew\n<!-- /TRIAL -->"


@pytest.mark.parametrize("text", ["", "<!-- TRIAL -->\n", "<!-- /TRIAL -->\n<!-- TRIAL -->\n", 2 * "<!-- TRIAL -->\n<!-- /TRIAL -->\n"])
def test_marks_that_are_missing_or_there_twice_are_told(tmp_path, text):
    path = tmp_path / "results.md"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"results\.md' needs the lines '<!-- TRIAL -->' and '<!-- /TRIAL -->', once each"):
        check_marks(path, "TRIAL")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(MissingFileError, match="no file at"):
        check_marks(tmp_path / "results.md", "TRIAL")

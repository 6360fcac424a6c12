"""Options of the command line that may be left out."""

from typing import Any

from tyro.conf import arg


def option(metavar: str, *aliases: str) -> Any:
    """An option that may be left out: the config file decides then, and the defaults last."""
    return arg(metavar=metavar, aliases=aliases, help_behavior_hint="")

"""Where many tasks are done."""

from typing import Literal

ExecutorName = Literal["local", "ray"]

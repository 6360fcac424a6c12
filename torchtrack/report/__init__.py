"""Finished runs as pages that a browser shows."""

from torchtrack.report.page import write_report

__all__ = ["write_report"]

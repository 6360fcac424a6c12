"""Optical-flow guided 6DoF object pose tracking with an event camera."""

__version__ = "0.1.0"

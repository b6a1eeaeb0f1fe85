"""Calibration: printed board and photos → cameras and rigs, with honest uncertainty."""

from sfm import __version__

__all__ = ["__version__"]

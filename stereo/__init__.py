"""Stereo: rectified pairs → disparity and depth; flow; reconstructions → dense clouds and meshes."""

from sfm import __version__

__all__ = ["__version__"]

"""Structure from motion: photos → camera poses and a sparse model."""

__version__ = "0.1.0"

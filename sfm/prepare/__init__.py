"""A dark, flat or noisy grey image in, one in which more features are found out."""

from sfm.prepare.preparation import PrepareConfig, Prepared, prepare

__all__ = ["PrepareConfig", "Prepared", "prepare"]

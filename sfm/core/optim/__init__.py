"""Nonlinear least squares: robust losses, the damping loop, elimination of small blocks, linear solvers."""

from sfm.core.optim.levenberg_marquardt import Damping, Iteration, StopRules, Summary, System, Trial, minimize
from sfm.core.optim.losses import Loss, evaluate_loss

__all__ = ["Damping", "Iteration", "Loss", "StopRules", "Summary", "System", "Trial", "evaluate_loss", "minimize"]

"""Camera parameters that may not leave an interval.

A step that would take a parameter out of its interval ends on the bound, and everything else moves as is best then
(see `sfm.core.optim.box`). At the end the gradient presses a parameter against the bound on which it is, or it is not
on one: the conditions of Karush, Kuhn and Tucker.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.bundle.layout import Layout
from sfm.bundle.problem import BundleProblem
from sfm.core.arrays import FloatArray
from sfm.core.optim.block_pattern import BLOCK
from sfm.core.optim.box import Box


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ParamBounds:
    """The free parameters that have a bound, K of them.

    Attributes:
        cells: camera and column of each; places: its row of six and its place there.
        lower, upper: (K,) −inf and inf where there is none.
    """

    cells: tuple[np.ndarray, np.ndarray]
    places: tuple[np.ndarray, np.ndarray]
    lower: FloatArray
    upper: FloatArray

    @staticmethod
    def of(problem: BundleProblem, layout: Layout) -> ParamBounds:
        """Those of the rows of `layout`."""
        camera, column, row, place = layout.parameters
        lower, upper = (bound[camera, column] for bound in problem.param_bounds)
        mine = np.flatnonzero((lower > -np.inf) | (upper < np.inf))
        return ParamBounds((camera[mine], column[mine]), (row[mine], place[mine]), lower[mine], upper[mine])

    def __len__(self) -> int:
        return len(self.lower)

    def room(self, params: FloatArray) -> Box:
        """How much each may change, by its number among all unknowns."""
        here = params[self.cells]
        return Box(BLOCK * self.places[0] + self.places[1], self.lower - here, self.upper - here)

    def projected(self, gradient: FloatArray, params: FloatArray) -> FloatArray:
        """The gradient (rows, 6) without what only presses parameters against their bounds."""
        if not len(self):
            return gradient
        here, g = params[self.cells], gradient[self.places]
        pressed = ((here <= self.lower) & (g > 0)) | ((here >= self.upper) & (g < 0))
        out = gradient.copy()
        out[self.places] = np.where(pressed, 0.0, g)
        return out

    def settle(self, params: FloatArray, sides: np.ndarray) -> None:
        """Sets parameters that ended on a side (K,) to the very number of the bound, and all others within."""
        within = np.clip(params[self.cells], self.lower, self.upper)
        params[self.cells] = np.where(sides < 0, self.lower, np.where(sides > 0, self.upper, within))

"""What the kernels of the loop ask of a problem, and which problems there are.

A problem is a named tuple with its data. numba compiles them once for each type of tuple, and the functions here
are, in each, those of the type's own module, which are plain functions, since nothing else calls them compiled:

    solve            fills an array with the models of minimal samples, rows of indices; returns how many
    plausible        whether a model is possible for the sample that it was made of
    squared_errors   r² of data start … stop under a model
    parameters       the number of parameters that the refinement moves
    start            the state of a model, the form in which it is refined; False if it has none
    model_of         the model of a state
    moved            the state after a step in its tangent space
    equations        adds JᵀWJ (lower triangle) and JᵀWr to its arguments; returns the cost Σ ρ(r²)

Models and states have at most SIZE numbers.
"""

from __future__ import annotations

import functools

from numba.extending import overload

from sfm.core.robust import (
    _absolute_pose_kernels,
    _focal_resection_kernels,
    _focal_views_kernels,
    _two_view_kernels,
)

SIZE = 12
_MODULES = {
    _two_view_kernels.TwoViews: _two_view_kernels,
    _absolute_pose_kernels.Resection: _absolute_pose_kernels,
    _focal_views_kernels.FocalViews: _focal_views_kernels,
    _focal_resection_kernels.FocalResection: _focal_resection_kernels,
}


def solve(problem, samples, models):
    return _MODULES[type(problem)].solve(problem, samples, models)


def plausible(problem, model, sample):
    return _MODULES[type(problem)].plausible(problem, model, sample)


def squared_errors(problem, model, start, stop, out):
    _MODULES[type(problem)].squared_errors(problem, model, start, stop, out)


def parameters(problem):
    return _MODULES[type(problem)].parameters(problem)


def start(problem, model, state):
    return _MODULES[type(problem)].start(problem, model, state)


def model_of(problem, state, model):
    _MODULES[type(problem)].model_of(problem, state, model)


def moved(problem, state, step):
    return _MODULES[type(problem)].moved(problem, state, step)


def equations(problem, state, loss, square_scale, max_square, hessian, gradient):
    return _MODULES[type(problem)].equations(problem, state, loss, square_scale, max_square, hessian, gradient)


def _specialised(generic):
    """Has numba compile the function of that name in the module of the problem's type in the generic one's place."""

    def chosen(problem, *_):
        return getattr(_MODULES[problem.instance_class], generic.__name__)

    overload(generic)(functools.update_wrapper(chosen, generic))


for _generic in (solve, plausible, squared_errors, parameters, start, model_of, moved, equations):
    _specialised(_generic)

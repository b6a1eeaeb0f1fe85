"""Steps on the manifolds of poses and matrices, and the derivatives of matrices by such steps.

States are flat rows; 3 × 3 matrices are stored by rows. Rotations are updated on the left, R ← exp([ω]×) R.

    essential      R (9), unit t (3)     E = [t]× R    5 parameters: two of t in the plane ⟂ t, ω
    fundamental    M (9), unit t (3)     F = [t]× M    8 parameters: two of t, six of M in that plane; one is the scale
    pose           R (9), t (3)                        6 parameters: ω, υ; t ← t + υ

Nothing depends on the scale of F, which is why the damping of the normal equations must not vanish.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def rotate(matrix, x, y, z):
    """matrix (9,) ← exp([ω]×) matrix, ω = (x, y, z), in place."""
    angle = np.sqrt(x * x + y * y + z * z)
    a = np.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-4 else 0.5
    for j in range(3):
        p, q, r = matrix[j], matrix[3 + j], matrix[6 + j]
        u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
        matrix[j] = p + a * u + b * (y * w - z * v)
        matrix[3 + j] = q + a * v + b * (z * u - x * w)
        matrix[6 + j] = r + a * w + b * (x * v - y * u)


@njit(cache=True, nogil=True, error_model="numpy")
def _cross_product(v, matrix, out):
    """out (9,) = [v]× matrix."""
    for j in range(3):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            out[3 * i + j] = v[a] * matrix[3 * b + j] - v[b] * matrix[3 * a + j]


@njit(cache=True, nogil=True, error_model="numpy")
def _plane_basis(t, basis):
    """Fills the rows of `basis` with two orthonormal vectors ⟂ unit t, a continuous function of t near it."""
    k = 0
    for i in range(1, 3):
        if abs(t[i]) < abs(t[k]):
            k = i
    norm = np.sqrt(1.0 - t[k] * t[k])
    for i in range(3):
        basis[0, i] = ((1.0 if i == k else 0.0) - t[k] * t[i]) / norm
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        basis[1, i] = t[a] * basis[0, b] - t[b] * basis[0, a]


@njit(cache=True, nogil=True, error_model="numpy")
def moved_matrix(state, step):
    """The state of an essential or, with steps of eight, a fundamental matrix after a step."""
    new, basis = state.copy(), np.empty((2, 3))
    _plane_basis(state[9:], basis)
    if step.shape[0] == 5:
        rotate(new, step[2], step[3], step[4])
    else:
        square = 0.0
        for i in range(9):
            new[i] += step[2 + i % 3] * basis[0, i // 3] + step[5 + i % 3] * basis[1, i // 3]
            square += new[i] * new[i]
        for i in range(9):
            new[i] /= np.sqrt(square)
    square = 0.0
    for i in range(3):
        new[9 + i] += step[0] * basis[0, i] + step[1] * basis[1, i]
        square += new[9 + i] * new[9 + i]
    for i in range(3):
        new[9 + i] /= np.sqrt(square)
    return new


@njit(cache=True, nogil=True, error_model="numpy")
def matrix_of(state, model):
    """Fills `model` with [t]× M."""
    _cross_product(state[9:], state, model)


@njit(cache=True, nogil=True, error_model="numpy")
def matrix_tangent(state, tangent):
    """Fills `tangent` (5 or 8, 9) with the derivatives of [t]× M by the steps of `moved_matrix`."""
    basis, changed = np.empty((2, 3)), np.zeros(9)
    _plane_basis(state[9:], basis)
    for k in range(2):
        _cross_product(basis[k], state, tangent[k])
    if tangent.shape[0] == 5:
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            for j in range(3):
                changed[3 * k + j], changed[3 * a + j], changed[3 * b + j] = 0.0, -state[3 * b + j], state[3 * a + j]
            _cross_product(state[9:], changed, tangent[2 + k])
    else:
        # [t]× takes the first vector of the basis to the second, and this to minus the first.
        for i in range(9):
            for j in range(3):
                same = 1.0 if i % 3 == j else 0.0
                tangent[2 + j, i], tangent[5 + j, i] = same * basis[1, i // 3], -same * basis[0, i // 3]


@njit(cache=True, nogil=True, error_model="numpy")
def matrix_state(m, calibrated, state):
    """Fills `state` from E or F; False where its rank is below two.

    The left null vector t is the longest cross product of two columns, and M = −[t]× F. With E of norm √2 the cofactors
    are t tᵀ R, so that R = cof E − [t]× E.
    """
    cofactors, square, longest, best = np.empty((3, 3)), 0.0, 0.0, 0
    for j in range(3):
        c, d = (j + 1) % 3, (j + 2) % 3
        norm = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            square += m[3 * i + j] * m[3 * i + j]
            cofactors[i, j] = m[3 * a + c] * m[3 * b + d] - m[3 * a + d] * m[3 * b + c]
            norm += cofactors[i, j] * cofactors[i, j]
        if norm > longest:
            longest, best = norm, j
    if not (longest > 1e-20 * square * square and square < np.inf):
        return False
    for i in range(3):
        state[9 + i] = -cofactors[i, best] / np.sqrt(longest)
    _cross_product(state[9:], m, state)
    for i in range(3):
        state[9 + i] = -state[9 + i]
        for j in range(3):
            state[3 * i + j] *= np.sqrt(2.0 / square)
            if calibrated:
                state[3 * i + j] += cofactors[i, j] * 2.0 / square
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def moved_pose(state, step):
    """The state after a step of six; further entries of state and step add (a logarithmic focal factor)."""
    new = state.copy()
    rotate(new, step[0], step[1], step[2])
    for k in range(3, step.shape[0]):
        new[6 + k] += step[k]
    return new

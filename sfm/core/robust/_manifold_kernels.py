"""Steps on the manifolds of poses and matrices, and the derivatives of matrices by such steps.

States are flat rows; 3 × 3 matrices are stored by rows. Rotations are updated on the left, R ← exp([ω]×) R.

    essential      R (9), unit t (3)            E = [t]× R                5 parameters: ω, two in the plane ⟂ t
    fundamental    U (9), V (9), σ              F = U diag(1, σ, 0) Vᵀ     7 parameters: of U, of V, σ
    pose           R (9), t (3)                                           6 parameters: ω, υ; t ← t + υ

Reference:
    Bartoli & Sturm, Nonlinear estimation of the fundamental matrix with minimal parameters, PAMI 2004.
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
def moved_essential(state, step):
    """The state after a step of five."""
    new, basis = state.copy(), np.empty((2, 3))
    rotate(new, step[0], step[1], step[2])
    _plane_basis(state[9:], basis)
    square = 0.0
    for i in range(3):
        new[9 + i] += step[3] * basis[0, i] + step[4] * basis[1, i]
        square += new[9 + i] * new[9 + i]
    for i in range(3):
        new[9 + i] /= np.sqrt(square)
    return new


@njit(cache=True, nogil=True, error_model="numpy")
def essential_tangent(state):
    """E (9,) and its derivatives (5, 9)."""
    essential, tangent, rotated = np.empty(9), np.empty((5, 9)), np.empty(9)
    _cross_product(state[9:], state, essential)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        for j in range(3):
            rotated[3 * k + j], rotated[3 * a + j], rotated[3 * b + j] = 0.0, -state[3 * b + j], state[3 * a + j]
        _cross_product(state[9:], rotated, tangent[k])
    basis = np.empty((2, 3))
    _plane_basis(state[9:], basis)
    for k in range(2):
        _cross_product(basis[k], state, tangent[3 + k])
    return essential, tangent


@njit(cache=True, nogil=True, error_model="numpy")
def moved_fundamental(state, step):
    """The state after a step of seven."""
    new = state.copy()
    rotate(new, step[0], step[1], step[2])
    rotate(new[9:], step[3], step[4], step[5])
    new[18] += step[6]
    return new


@njit(cache=True, nogil=True, error_model="numpy")
def fundamental_tangent(state):
    """F (9,) and its derivatives (7, 9)."""
    fundamental, tangent = np.empty(9), np.empty((7, 9))
    for i in range(3):
        for j in range(3):
            tangent[6, 3 * i + j] = state[3 * i + 1] * state[9 + 3 * j + 1]
            fundamental[3 * i + j] = state[3 * i] * state[9 + 3 * j] + state[18] * tangent[6, 3 * i + j]
    # [e_k]× F and F [e_k]×ᵀ: two rows, or columns, change places and one its sign.
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        for j in range(3):
            tangent[k, 3 * k + j] = tangent[3 + k, 3 * j + k] = 0.0
            tangent[k, 3 * a + j], tangent[k, 3 * b + j] = -fundamental[3 * b + j], fundamental[3 * a + j]
            tangent[3 + k, 3 * j + a], tangent[3 + k, 3 * j + b] = -fundamental[3 * j + b], fundamental[3 * j + a]
    return fundamental, tangent


@njit(cache=True, nogil=True, error_model="numpy")
def moved_pose(state, step):
    """The state after a step of six; further entries of state and step add (a logarithmic focal factor)."""
    new = state.copy()
    rotate(new, step[0], step[1], step[2])
    for k in range(3, step.shape[0]):
        new[6 + k] += step[k]
    return new

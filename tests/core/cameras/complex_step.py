"""Every camera model in complex arithmetic, for derivatives by complex steps.

An analytic f satisfies  f(x + ih) = f(x) + i h f'(x) + O(h²),  so that  Im f(x + ih) / h  is the derivative to the last
digit with h as small as 1e-100: nothing is subtracted. For that the formulas must be written without |·| and atan2.

Reference:
    Squire & Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 1998.
"""

from __future__ import annotations

import numpy as np

from sfm.core.cameras import model_by_name

STEP = 1e-100


def project(model: str, params: np.ndarray, points3D: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the camera frame; both may be complex."""
    p = dict(zip(model_by_name(model).param_names, params, strict=True))
    x, y, z = points3D.T
    if model == "EQUIRECTANGULAR":
        longitude, latitude = _angle(x, z), _angle(y, np.sqrt(x * x + z * z))
        return np.stack([(longitude / (2 * np.pi) + 0.5) * p["w"], (latitude / np.pi + 0.5) * p["h"]], axis=1)
    if model == "EUCM":
        d = np.sqrt(p["beta"] * (x * x + y * y) + z * z)
        a, b = x / (p["alpha"] * d + (1 - p["alpha"]) * z), y / (p["alpha"] * d + (1 - p["alpha"]) * z)
    elif model == "DOUBLE_SPHERE":
        xi, alpha = p["xi"], p["alpha"]
        w = xi * np.sqrt(x * x + y * y + z * z) + z
        m = alpha * np.sqrt(x * x + y * y + w * w) + (1 - alpha) * w
        a, b = x / m, y / m
    elif model_by_name(model).is_fisheye:
        r = np.sqrt(x * x + y * y)
        a, b = _angle(r, z) / r * x, _angle(r, z) / r * y
    else:
        a, b = x / z, y / z
    a, b = _distorted(model, p, a, b)
    fx, fy = p.get("fx", p.get("f")), p.get("fy", p.get("f"))
    return np.stack([fx * a + p["cx"], fy * b + p["cy"]], axis=1)


def by_point(model: str, params: np.ndarray, points3D: np.ndarray) -> np.ndarray:
    """(N, 2, 3)."""
    steps = 1j * STEP * np.eye(3)
    return np.stack([np.imag(project(model, params, points3D + step)) / STEP for step in steps], axis=2)


def by_params(model: str, params: np.ndarray, points3D: np.ndarray) -> np.ndarray:
    """(N, 2, number of parameters)."""
    steps = 1j * STEP * np.eye(len(params))
    return np.stack([np.imag(project(model, params + step, points3D)) / STEP for step in steps], axis=2)


def _angle(opposite: np.ndarray, adjacent: np.ndarray) -> np.ndarray:
    """atan2 by the tangent of half the angle, in the form that does not cancel."""
    hypotenuse = np.sqrt(opposite * opposite + adjacent * adjacent)
    ahead = np.real(adjacent) > 0
    # tan(φ/2) = s / (1 + c), which is (1 − c) / s where c < 0.
    numerator = np.where(ahead, opposite, hypotenuse - adjacent)
    denominator = np.where(ahead, hypotenuse + adjacent, opposite)
    return 2 * np.arctan(numerator / denominator)


def _distorted(model: str, p: dict[str, complex], a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radial (rational for FULL_OPENCV and the like), tangential and thin-prism terms, as far as the model has them."""
    s = a * a + b * b
    k1, k2, k3, k4 = (p.get(name, p.get("k", 0.0) if name == "k1" else 0.0) for name in ("k1", "k2", "k3", "k4"))
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3 + k4 * s**4
    if model.startswith("FULL_OPENCV"):
        radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + p["k5"] * s**2 + p["k6"] * s**3)
    p1, p2 = p.get("p1", 0.0), p.get("p2", 0.0)
    prism_a = p.get("sx1", p.get("s1", 0.0)) * s + p.get("s2", 0.0) * s**2
    prism_b = p.get("sy1", p.get("s3", 0.0)) * s + p.get("s4", 0.0) * s**2
    return (
        a * radial + 2 * p1 * a * b + p2 * (s + 2 * a * a) + prism_a,
        b * radial + 2 * p2 * a * b + p1 * (s + 2 * b * b) + prism_b,
    )

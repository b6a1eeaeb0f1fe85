"""Points projected side by side equal those projected one by one."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import MODELS
from sfm.core.cameras import _lane_kernels as lanes
from sfm.core.cameras._kernels import MAX_PARAMS, distortion_limit, project_with_jacobians
from sfm.core.cameras._lane_kernels import LANES

DISTORTION = [-0.05, 0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001, 0.002, -0.001, 0.003, 0.0005]


def params_of(model):
    focal, center = (model.focal_indices, model.principal_point_indices)
    params, rest = np.zeros(MAX_PARAMS), iter(DISTORTION)
    for k in range(len(model.param_names)):
        params[k] = 800.0 + k if k in focal else 400.0 - 9 * k if k in center else next(rest)
    if model.name == "EUCM":
        params[4:6] = 0.6, 1.1
    if model.name == "EQUIRECTANGULAR":
        params[:2] = 2000, 1000
    return params


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_lanes_equal_single_points(rng, model):
    params = params_of(model)
    points = rng.normal(size=(LANES, 3)) * [1, 1, 2] + [0, 0, 2]
    points[3], points[5], points[7], points[9] = np.nan, [1, 2, 0], [np.inf, 0, 1], [50, 0, 1]
    points[-8:] = points[-9]  # where there are fewer points than lanes
    w = np.full(lanes.ROWS * LANES, np.nan)
    rows = w.reshape(-1, LANES)
    rows[:3] = points.T
    lanes.project_lanes(model.model_id, params, distortion_limit(model.model_id, params) ** 2, w)
    points2D, by_point, by_params, valid = project_with_jacobians(model.model_id, params, points)
    np.testing.assert_array_equal(rows[lanes.OK], valid)
    assert valid.sum() > LANES // 2
    np.testing.assert_allclose(rows[[lanes.U, lanes.V]].T[valid], points2D[valid], rtol=1e-12, atol=1e-9)
    found = rows[lanes.BY_POINT : lanes.BY_POINT + 6].T.reshape(-1, 2, 3)[valid]
    np.testing.assert_allclose(found, by_point[valid], rtol=1e-11, atol=1e-9)
    for column in range(len(model.param_names)):
        lanes.fill_by_param(model.model_id, params, column, w)
        row = lanes.BY_PARAMS + 2 * column
        np.testing.assert_allclose(rows[row : row + 2].T[valid], by_params[valid, :, column], rtol=1e-11, atol=1e-9)
    assert np.isfinite(rows[3 : lanes.BY_POINT]).all()


def test_a_limit_below_zero_lets_pass_what_is_folded_over():
    model = next(model for model in MODELS if model.name == "RADIAL")
    params = np.zeros(MAX_PARAMS)
    params[:5] = 500, 400, 300, -0.5, 0.01
    radii = np.linspace(0, 2, LANES)
    w = np.full(lanes.ROWS * LANES, np.nan)
    rows = w.reshape(-1, LANES)
    rows[:3] = np.stack([radii, 0 * radii, 1 + 0 * radii])
    limit = distortion_limit(model.model_id, params)
    lanes.project_lanes(model.model_id, params, limit**2, w)
    np.testing.assert_array_equal(rows[lanes.OK], radii < limit)
    lanes.project_lanes(model.model_id, params, -np.inf, w)
    assert rows[lanes.OK].all()
    np.testing.assert_allclose(rows[lanes.U], 400 + 500 * radii * (1 - 0.5 * radii**2 + 0.01 * radii**4), rtol=1e-13)

"""A whole adjustment is the same with kernels that numba compiled and with the plain Python that they are."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

_PROGRAM = """
import dataclasses, json
import numpy as np
from sfm.bundle import BundleConfig, BundleCovariance, adjust, covariance
from sfm.bundle.priors import DistancePrior, PointPrior, PositionPrior
from tests.bundle.test_rigs import build_rig, disturbed
from sfm.core.cameras._kernels import MAX_PARAMS

rng = np.random.default_rng(0)
truth = build_rig(rng, points=9, free_sensors=True, free_params=(0, 3))
rows, centers = np.arange(3, dtype=np.int32), truth.cams_from_world.center
start = dataclasses.replace(
    disturbed(truth, rng, 0.002),
    obs_sigmas=rng.uniform(0.5, 2.0, len(truth.obs_images)),
    prior_params=truth.camera_params,
    prior_sigmas=np.full((1, MAX_PARAMS), 0.1),
    priors=(
        PositionPrior.of_sigmas(rows, centers[:3] + 0.01, 0.02, bias_sigma=0.1),
        DistancePrior(rows[:1], rows[2:] + 6, np.ones(1) * np.linalg.norm(centers[0] - centers[8]), np.full(1, 0.01)),
        PointPrior.of_sigmas(rows, truth.points3D[:3], 0.01),
    ),
)
out = {}
for solver in ("dense", "sparse", "iterative"):
    config = BundleConfig(loss="cauchy", max_iterations=2, solver=solver)
    found = adjust(start, config)
    poses = found.problem.cams_from_world.matrix
    out[solver] = [
        [row.cost for row in found.table], [row.gradient_max for row in found.table],
        [row.gain for row in found.table], found.problem.points3D.tolist(), poses.tolist(),
        found.problem.camera_params.tolist(), found.biases.tolist(),
    ]
known = covariance(found.problem)
assert isinstance(known, BundleCovariance)
out["covariance"] = [known.poses.tolist(), known.points3D.tolist(), known.params.tolist()]
print(json.dumps(out))
"""


def outcome(disabled: str, environment: dict[str, str]) -> dict[str, list]:
    env = {**environment, "NUMBA_DISABLE_JIT": disabled}
    run = subprocess.run([sys.executable, "-c", _PROGRAM], env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT", "0") != "0", reason="nothing is compiled")
def test_a_whole_adjustment_is_the_same_without_compilation(environment):
    compiled, interpreted = (outcome(disabled, environment) for disabled in ("0", "1"))
    assert len(compiled["dense"][0]) == 3
    assert compiled["dense"][0][2] < 0.1 * compiled["dense"][0][0]
    for name, parts in compiled.items():
        for found, expected in zip(interpreted[name], parts, strict=True):
            size = np.abs(np.array(expected)).max()
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * size, err_msg=name)

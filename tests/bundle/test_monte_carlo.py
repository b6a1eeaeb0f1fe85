"""Predicted covariances against the scatter of estimates from repeated measurements.

Each kind is judged by one number, the root of the mean of eᵀ Σ⁻¹ e over its dimensions, runs and members, which is
the ratio of the true standard deviations to the predicted ones. Errors of different poses in a run are not
independent, so that its own sampling error is that of runs × dimensions of one member at worst: 1 / √(2 · 450 · 2),
2.4 % for the camera parameters, and less for the others.

Fifteen runs at a time are one problem of scenes that have nothing in common, each with two poses held.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance, squared_errors
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.bundle.conftest import build

_RUNS, _TOGETHER = 450, 15
_CONFIG = BundleConfig(relative_cost_tolerance=1e-9)


def side_by_side(scenes: list[BundleProblem]) -> BundleProblem:
    """One problem of scenes that have as many cameras, images and points."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(scene, name) for scene in scenes])

    def shifted(name: str, by: int) -> np.ndarray:
        return np.concatenate([getattr(scene, name) + np.int32(k * by) for k, scene in enumerate(scenes)])

    first, poses = scenes[0], [scene.cams_from_world for scene in scenes]
    images, points = len(first.free_poses), len(first.free_points)
    columns = ("model_ids", "camera_params", "points3D", "obs_points2D", "free_params", "free_poses", "free_points")
    return BundleProblem(
        **{name: joined(name) for name in (*columns, "obs_sigmas")},
        image_cameras=shifted("image_cameras", len(first.model_ids)),
        obs_images=shifted("obs_images", images),
        obs_points=shifted("obs_points", points),
        cams_from_world=Rigid3(
            Rotation3(np.concatenate([pose.rotation.wxyz for pose in poses])),
            np.concatenate([pose.translation for pose in poses]),
        ),
    )


def measured_again(truth: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """With noise of the standard deviations that the problem states."""
    assert truth.obs_sigmas is not None
    noise = truth.obs_sigmas[:, None] * rng.normal(size=truth.obs_points2D.shape)
    return dataclasses.replace(truth, obs_points2D=truth.obs_points2D + noise)


def ratio(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Of errors (runs, N, d) to the standard deviations of (N, d, d)."""
    squares = np.einsum("rna,nab,rnb->rn", errors, np.linalg.inv(covariances), errors)
    return float(np.sqrt(squares.mean() / errors.shape[2]))


@dataclasses.dataclass(frozen=True)
class Scatter:
    """The truth, what is predicted of it, and the errors of all runs (runs, N, …)."""

    truth: BundleProblem
    predicted: BundleCovariance
    centers: np.ndarray
    rotations: np.ndarray
    params: np.ndarray
    points3D: np.ndarray
    costs: np.ndarray


@pytest.fixture(scope="module")
def scatter() -> Scatter:
    """The runs start from the truth."""
    rng = np.random.default_rng(5)
    truth = build(rng, images=6, points=50, model="SIMPLE_RADIAL", cameras=2, free_params=(0, 3), seen=0.9)
    sigmas = np.where(np.arange(len(truth.obs_images)) % 2, 0.2, 0.4)
    truth = dataclasses.replace(truth, obs_sigmas=sigmas, free_poses=np.arange(6) >= 2)
    predicted = covariance(truth)
    assert isinstance(predicted, BundleCovariance)
    true = side_by_side([truth] * _TOGETHER)
    parts: list[tuple[np.ndarray, ...]] = []
    for _ in range(_RUNS // _TOGETHER):
        found = adjust(measured_again(true, rng), _CONFIG).problem
        poses, true_poses = found.cams_from_world, true.cams_from_world
        assert true.obs_sigmas is not None
        parts.append((
            poses.center - true_poses.center,
            (poses.rotation @ true_poses.rotation.inverse()).log(),
            (found.camera_params - true.camera_params)[:, [0, 3]],
            found.points3D - true.points3D,
            squared_errors(found) / true.obs_sigmas**2,
        ))  # fmt: skip
    runs = [
        np.concatenate([part.reshape(_TOGETHER, -1, *part.shape[1:]) for part in kind])
        for kind in zip(*parts, strict=True)
    ]
    centers, rotations, params, points3D, squares = runs
    return Scatter(truth, predicted, centers, rotations, params, points3D, squares.sum(axis=1))


def test_centres_scatter_as_predicted(scatter):
    assert 0.9 < ratio(scatter.centers[:, 2:], scatter.predicted.centers[2:]) < 1.1
    assert not scatter.centers[:, :2].any()
    assert not scatter.predicted.centers[:2].any()


def test_rotations_scatter_as_predicted(scatter):
    """By their angles: the mean square is the trace, in whatever axes a tangent is written."""
    squares = (scatter.rotations**2).sum(axis=2).mean(axis=0)
    traces = np.trace(scatter.predicted.poses[:, :3, :3], axis1=1, axis2=2)
    assert 0.9 < np.sqrt((squares[2:] / traces[2:]).mean()) < 1.1
    assert (squares[:2] < 1e-20).all()
    assert not traces[:2].any()


def test_camera_parameters_scatter_as_predicted(scatter):
    blocks = scatter.predicted.params[:, [0, 3]][:, :, [0, 3]]
    assert 0.9 < ratio(scatter.params, blocks) < 1.1


def test_points_scatter_as_predicted(scatter):
    known = np.isfinite(scatter.predicted.points3D).all(axis=(1, 2))
    assert known.sum() >= 45
    assert 0.9 < ratio(scatter.points3D[:, known], scatter.predicted.points3D[known]) < 1.1


def test_the_cost_is_what_is_left_of_the_noise(scatter):
    """2 F is χ² with as many degrees of freedom as there are equations more than unknowns."""
    freedom = 2 * len(scatter.truth.obs_images) - 3 * len(scatter.truth.points3D) - 6 * 4 - 4
    assert abs(scatter.costs.mean() / freedom - 1) < 0.02
    assert abs(scatter.costs.var() / (2 * freedom) - 1) < 0.3

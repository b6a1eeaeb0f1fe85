"""A camera that changes between photos is told from one that does not, and what of it changed."""

from __future__ import annotations

import numpy as np
import pytest

from calib.diagnose import diagnose
from calib.diagnose_changes import changed_camera, own_cameras
from calib.refine import CalibrationConfig, calibrate
from calib.turned_photos import turned_photos
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from tests.calib.boards_in_space import FISHEYE, LENS, PINHOLE, flat_board, poses_before, seen

BOARD = flat_board()
LENS_OF = {"OPENCV": "opencv4", "OPENCV_FISHEYE": "fisheye", "PINHOLE": "pinhole"}


def taken_by(cameras, rng, noise_px=0.02):
    """One view by each of the cameras."""
    views = []
    for k, (camera, pose) in enumerate(zip(cameras, poses_before(cameras[0], len(cameras), rng), strict=True)):
        (view,) = seen(camera, BOARD, [pose], rng, noise_px)
        views.append(type(view)(f"view{k:02d}", view.width, view.height, view.corner_ids, view.points2D))
    return views


def calibrated(views, lens, **how):
    found = calibrate(BOARD, views, CalibrationConfig(lens=lens, reject=False, **how))
    assert not isinstance(found, Rejected), found
    return found


def zoomed(camera: Camera, factor: float) -> Camera:
    params = np.array(camera.params)
    params[list(camera.model_info.focal_indices)] *= factor
    return camera.with_params(params)


def moved(camera: Camera, by) -> Camera:
    params = np.array(camera.params)
    params[list(camera.model_info.principal_point_indices)] += by
    return camera.with_params(params)


@pytest.mark.parametrize("camera", [LENS, FISHEYE, PINHOLE], ids=["opencv", "fisheye", "pinhole"])
def test_of_one_camera_s_photos_nothing_is_told(camera, rng):
    for count, noise in ((6, 0.02), (14, 0.02), (14, 0.3)):
        assert changed_camera(calibrated(taken_by([camera] * count, rng, noise), LENS_OF[camera.model])) is None


@pytest.mark.parametrize("camera", [LENS, FISHEYE, PINHOLE], ids=["opencv", "fisheye", "pinhole"])
def test_a_focus_that_drifts_is_told_by_how_much(camera, rng):
    factors = np.linspace(0.985, 1.015, 14)
    found = changed_camera(calibrated(taken_by([zoomed(camera, k) for k in factors], rng), LENS_OF[camera.model]))
    assert found is not None
    assert found.kind == "focal"
    assert found.own_noise_px == pytest.approx(0.02, rel=0.15)
    own = found.own[:, 0] - found.own[:, 0].mean()
    off = own - (np.log(factors) - np.log(factors).mean())
    assert np.sqrt(np.mean(off**2)) < 0.002


def test_photos_of_another_focus_are_named(rng):
    wrong = {2, 5, 8}
    found = calibrated(taken_by([zoomed(LENS, 1.15 if k in wrong else 1.0) for k in range(12)], rng), "opencv4")
    changed = changed_camera(found)
    assert changed is not None
    assert set(changed.apart) == wrong
    told = next(finding for finding in diagnose(found) if finding.cause == "changed_focus")
    assert told.detail.startswith("view02, view05, view08: the focal length is +1")
    assert not {"outlier_view", "correlated_corners", "lens_model"} & {finding.cause for finding in diagnose(found)}


def test_a_principal_point_that_moves_is_told(rng):
    cameras = [moved(LENS, rng.normal(0, 8, 2)) for _ in range(16)]
    found = calibrated(taken_by(cameras, rng), "opencv4")
    changed = changed_camera(found)
    assert changed is not None
    assert changed.kind == "center"
    assert "moved_principal_point" in {finding.cause for finding in diagnose(found)}
    off = changed.own - [camera.params[2:4] for camera in cameras]
    assert np.std(off - off.mean(0)) < 1.5


def test_a_bent_board_or_a_poor_lens_model_is_not_a_change(rng):
    views = taken_by([LENS] * 20, rng)
    assert changed_camera(calibrated(views, "simple_radial")) is None
    bent = BOARD + 0.001 * (1 - (BOARD[:, :1] / 0.12) ** 2) * [0, 0, 1.0]
    views = seen(LENS, bent, poses_before(LENS, 20, rng), rng, 0.02)
    assert changed_camera(calibrated(views, "opencv4")) is None


def test_a_zoom_is_not_taken_for_turned_photos(rng):
    for _ in range(4):
        views = taken_by([zoomed(LENS, 7 / 6 if k in (4, 5, 6) else 1.0) for k in range(12)], rng, 0.01)
        assert turned_photos(BOARD, views, CalibrationConfig(lens="opencv4")) is None


def test_what_photos_leave_open_stays_as_expected(rng):
    """Boards parallel to the image say nothing of the focal length of their photo."""
    poses = poses_before(PINHOLE, 8, rng) + poses_before(PINHOLE, 4, rng, tilt=0.0, reach=0.0)
    own = own_cameras(calibrated(seen(PINHOLE, BOARD, poses, rng, 0.02), "pinhole"), "focal")
    assert np.all(np.abs(own.own[8:]) < 0.05)
    assert np.median(own.sigmas[8:]) > 3 * np.median(own.sigmas[:8])

"""Calibration from corners: what it finds, what it leaves out, and what it refuses."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import FISHEYE, LENS, PINHOLE, flat_board, poses_before, seen, with_corners

BOARD = flat_board()
ALL = CalibrationConfig(lens="opencv4", reject=False)
PRISM = Camera(
    "FULL_OPENCV_THIN_PRISM", 1280, 960,
    np.array([900, 905, 644, 473, -0.2, 0.05, 1e-3, -5e-4, 0.01, 0.05, 0.02, 0.004, 2e-3, -1e-3, -3e-3, 1e-3]),
)  # fmt: skip
SPHERES = Camera("DOUBLE_SPHERE", 1280, 960, np.array([330.0, 332, 644, 473, -0.15, 0.58]))


def views_of(camera, rng, count=14, noise_px=0.1, board=BOARD, **how):
    return seen(camera, board, poses_before(camera, count, rng, **how), rng, noise_px)


def calibrated(views, config=ALL, board=BOARD) -> Calibration:
    found = calibrate(board, views, config)
    assert not isinstance(found, Rejected), found
    return found


def refused(views, config=ALL, board=BOARD) -> Rejected:
    found = calibrate(board, views, config)
    assert isinstance(found, Rejected)
    return found


# --- what it finds ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "lens"),
    [
        (PINHOLE, "pinhole"),
        (LENS, "opencv4"),
        (LENS, "opencv5"),
        (PRISM, "opencv12"),
        (FISHEYE, "fisheye"),
        (SPHERES, "double_sphere"),
    ],
    ids=["pinhole", "opencv4", "opencv5", "opencv12", "fisheye", "double_sphere"],
)
def test_without_noise_the_camera_is_the_true_one(camera, lens, rng):
    poses = poses_before(camera, 12, rng)
    found = calibrated(seen(camera, BOARD, poses, rng, 0.0), CalibrationConfig(lens=lens))
    assert found.rms_px < 1e-9
    assert found.converged
    pixels = rng.uniform(0, 1, (200, 2)) * [1280, 960]
    rays, valid = camera.unproject(pixels)
    np.testing.assert_allclose(found.camera.project(rays[valid])[0], pixels[valid], atol=1e-5)
    np.testing.assert_allclose(found.cams_from_board.translation, [p.translation for p in poses], atol=1e-8)


def in_24_bits(points: np.ndarray, zero: float = 0.0) -> np.ndarray:
    """As OpenCV takes them, counted from `zero`."""
    return (points - zero).astype(np.float32).astype(float) + zero


@pytest.mark.parametrize(
    ("lens", "flags"),
    [
        ("opencv4", cv2.CALIB_FIX_K3),
        ("opencv5", 0),
        ("opencv8", cv2.CALIB_RATIONAL_MODEL),
        ("opencv12", cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_not_above_opencv_s(lens, flags, seed):
    rng, board = np.random.default_rng(seed), in_24_bits(BOARD)
    views = [with_corners(view, in_24_bits(view.points2D, 0.5)) for view in views_of(LENS, rng, board=board)]
    found = calibrated(views, CalibrationConfig(lens=lens, reject=False, keep_invertible=False), board)
    theirs = cv2.calibrateCamera(
        [board[view.corner_ids].astype(np.float32) for view in views],
        [(view.points2D - 0.5).astype(np.float32).reshape(-1, 1, 2) for view in views],
        (1280, 960), np.eye(3), np.zeros(12),
        flags=flags,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12),
    )  # fmt: skip
    assert found.rms_px <= theirs[0] + 1e-9
    assert found.converged


@pytest.mark.parametrize("seed", range(2))
def test_the_cost_of_a_fisheye_is_not_above_opencv_s(seed):
    rng, board = np.random.default_rng(seed), in_24_bits(BOARD)
    views = [with_corners(view, in_24_bits(view.points2D, 0.5)) for view in views_of(FISHEYE, rng, board=board)]
    found = calibrated(views, CalibrationConfig(lens="fisheye", reject=False, keep_invertible=False), board)
    theirs = cv2.fisheye.calibrate(
        [board[view.corner_ids].reshape(1, -1, 3) for view in views],
        [(view.points2D - 0.5).reshape(1, -1, 2) for view in views],
        (1280, 960), np.eye(3), np.zeros(4),
        flags=cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12),
    )  # fmt: skip
    assert found.rms_px <= theirs[0] + 1e-9
    assert found.converged


@pytest.mark.parametrize("lens", ["opencv8", "opencv12"])
def test_coefficients_that_nothing_determines_leave_the_focal_length_determined(lens, rng):
    """Without distortion k1 and k4 do the same."""
    found = calibrated(views_of(PINHOLE, rng, noise_px=0.0), CalibrationConfig(lens=lens, reject=False))
    assert found.fallbacks == ()
    np.testing.assert_allclose(found.camera.params[:4], PINHOLE.params, rtol=1e-5)


def test_a_smooth_fisheye_is_seen_by_a_model_with_two_shape_parameters(rng):
    found = calibrated(views_of(FISHEYE, rng), CalibrationConfig(lens="eucm", reject=False))
    assert found.sigma_px < 0.11
    assert abs(found.camera.mean_focal_length / FISHEYE.mean_focal_length - 1) < 0.01


@pytest.mark.parametrize(("xi", "alpha"), [(-0.3, 0.55), (-0.1, 0.58), (0.25, 0.66), (0.5, 0.6)])
def test_a_double_sphere_is_found_on_either_side_of_the_unified_camera(xi, alpha, rng):
    camera = Camera("DOUBLE_SPHERE", 1280, 960, np.array([400 * (1 + xi), 402 * (1 + xi), 644, 473, xi, alpha]))
    found = calibrated(views_of(camera, rng, noise_px=0.0), CalibrationConfig(lens="double_sphere"))
    assert found.rms_px < 1e-9
    np.testing.assert_allclose(found.camera.params, camera.params, rtol=1e-5)


def test_a_unified_camera_leaves_xi_of_a_double_sphere_open_and_is_found():
    camera = Camera("DOUBLE_SPHERE", 1280, 960, np.array([400, 402, 644, 473, 0.0, 0.6]))
    found = calibrated(views_of(camera, np.random.default_rng(0)), CalibrationConfig(lens="double_sphere"))
    assert found.fallbacks == ("xi is held at 0: the photos do not tell it from the focal length",)
    assert "xi" not in found.free_names
    np.testing.assert_allclose(found.camera.params, camera.params, rtol=2e-3)


def test_a_double_sphere_sees_a_fisheye_about_as_well_as_the_enhanced_unified_model(rng):
    views = views_of(FISHEYE, rng)
    spheres, unified = (calibrated(views, CalibrationConfig(lens=lens)) for lens in ("double_sphere", "eucm"))
    assert spheres.sigma_px < 1.5 * unified.sigma_px


def test_the_noise_is_measured_free_of_what_parameters_absorb(rng):
    measured = [calibrated(views_of(LENS, rng, count=5, noise_px=0.2)).sigma_px for _ in range(12)]
    assert np.mean(measured) == pytest.approx(0.2, rel=0.03)


def test_the_unit_of_the_board_scales_poses_and_nothing_else(rng):
    views = views_of(LENS, rng)
    one, other = calibrated(views), calibrated(views, board=1000 * BOARD)
    np.testing.assert_allclose(other.camera.params, one.camera.params, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(
        other.cams_from_board.translation, 1000 * np.array(one.cams_from_board.translation), rtol=1e-6, atol=1e-5
    )


def test_the_order_of_views_and_corners_does_not_matter(rng):
    views = views_of(LENS, rng)
    shuffled = []
    for v in rng.permutation(len(views)):
        order = rng.permutation(len(views[v].corner_ids))
        shuffled.append(
            dataclasses.replace(views[v], corner_ids=views[v].corner_ids[order], points2D=views[v].points2D[order])
        )
    np.testing.assert_allclose(
        calibrated(shuffled).camera.params, calibrated(views).camera.params, rtol=1e-8, atol=1e-9
    )


def test_the_same_views_give_the_same_bits(rng):
    views = views_of(LENS, rng, count=30)
    one, other = calibrated(views), calibrated(views)
    np.testing.assert_array_equal(one.camera.params, other.camera.params)
    np.testing.assert_array_equal(one.residuals, other.residuals)


def test_more_views_than_seeds_end_at_the_same_minimum(rng):
    views = views_of(LENS, rng, count=40)
    found = calibrated(views)
    system = found.system()
    assert system.newton_decrement() < 1e-9 * found.cost
    assert len(found.observations) == 40
    assert found.sigma_px == pytest.approx(0.1, rel=0.05)


def test_corners_count_by_their_covariance(rng):
    poses = poses_before(LENS, 12, rng)
    blurred = []
    for view in seen(LENS, BOARD, poses, rng, 0.0):
        sigmas = np.where(rng.random(len(view.corner_ids)) < 0.5, 0.05, 1.5)
        noisy = view.points2D + sigmas[:, None] * rng.normal(size=view.points2D.shape)
        covariances = sigmas[:, None, None] ** 2 * np.eye(2)
        blurred.append(dataclasses.replace(view, points2D=noisy, covariances=covariances))
    plain = [dataclasses.replace(view, covariances=None) for view in blurred]

    def error(views):
        return abs(calibrated(views).camera.params[0] - LENS.params[0])

    assert error(blurred) < 0.5 * error(plain)


def test_the_problem_at_its_solution_is_the_one_that_was_solved():
    """Where distortion may fold over, some corners have a projection that a camera in use would refuse."""
    views = views_of(LENS, np.random.default_rng(7), count=6)
    found = calibrated(views, dataclasses.replace(ALL, lens="opencv8", keep_invertible=False))
    np.testing.assert_allclose(found.system().residuals(), found.residuals, atol=1e-9)
    kept = dataclasses.replace(found, keep_invertible=True)
    assert np.isnan(kept.system().residuals()).any()


def test_one_iteration_is_not_convergence(rng):
    assert not calibrated(views_of(LENS, rng), dataclasses.replace(ALL, max_iterations=1)).converged


# --- the board ----------------------------------------------------------------------------------------------------


def test_the_bend_of_a_board_is_found_to_a_tenth(rng):
    x = BOARD[:, 0] / 0.12
    bend = 0.0005
    bent = BOARD + np.stack([0 * x, 0 * x, bend * (1 - x**2)], 1)
    views = views_of(LENS, rng, count=20, board=bent)
    flat = calibrated(views)
    found = calibrated(views, dataclasses.replace(ALL, shape="paraboloid"))
    assert found.shape.coefficients[1] == pytest.approx(bend, rel=0.1)
    assert abs(found.shape.coefficients[2]) < 0.1 * bend
    assert found.shape.bend == pytest.approx(bend, rel=0.1)
    assert found.sigma_px < 0.105 < flat.sigma_px


def test_a_stretched_print_is_found(rng):
    views = views_of(LENS, rng, board=BOARD * [1.0, 1.002, 1.0])
    found = calibrated(views, dataclasses.replace(ALL, shape="scale"))
    assert found.shape.coefficients[0] == pytest.approx(0.002, rel=0.1)


def test_points_of_a_free_board_are_found_but_for_its_movements(rng):
    moved = BOARD + 0.0003 * rng.normal(size=BOARD.shape)
    views = views_of(LENS, rng, count=20, board=moved, reach=0.1)
    found = calibrated(views, dataclasses.replace(ALL, shape="free"))
    basis = found.shape.basis.reshape(-1, found.shape.basis.shape[2])
    expected = basis @ (basis.T @ (moved - BOARD).ravel())
    error = found.shape.displacements.ravel() - expected
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(expected**2))
    assert found.sigma_px == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize("kind", ["height", "free"])
def test_shapes_leave_out_what_a_movement_would_undo(kind, rng):
    from calib.refine_board import board_shape

    shape = board_shape(kind, BOARD)
    basis = shape.basis.reshape(-1, shape.basis.shape[2])
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    turned = np.cross(rng.normal(size=3) * ([1, 1, 0] if kind == "height" else 1), BOARD)
    shifted = turned + rng.normal(size=3) * ([0, 0, 1] if kind == "height" else 1)
    grown = shifted if kind == "height" else shifted + 0.3 * BOARD
    np.testing.assert_allclose(basis.T @ grown.ravel(), 0, atol=1e-12)


# --- what it leaves out -------------------------------------------------------------------------------------------


def spoilt(view: BoardView, rng, count: int, by_px: float) -> BoardView:
    points2D = np.array(view.points2D)
    points2D[rng.permutation(len(points2D))[:count]] += by_px * rng.normal(size=(min(count, len(points2D)), 2))
    return with_corners(view, points2D)


@pytest.mark.parametrize(("count", "by_px"), [(3, 20.0), (6, 200.0)])
def test_corners_that_are_far_off_are_left_out(count, by_px, rng):
    views = views_of(LENS, rng)
    found = calibrated([spoilt(view, rng, count, by_px) for view in views], CalibrationConfig(lens="opencv4"))
    wrong = 14 * count
    assert 0.85 * wrong < len(found.rejected_corners) < 1.05 * wrong
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)
    assert not found.rejected_views


def test_nothing_is_left_out_of_good_views(rng):
    found = calibrated(views_of(LENS, rng, count=20), CalibrationConfig(lens="opencv4"))
    assert found.rejected_corners == ()
    assert found.rejected_views == ()


def test_a_view_that_does_not_fit_is_named(rng):
    views = views_of(LENS, rng)
    views[4] = spoilt(views[4], rng, 99, 4.0)
    found = calibrated(views, CalibrationConfig(lens="opencv4"))
    assert [(view.name, view.reason) for view in found.rejected_views] == [("view04", "outlier_view")]
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)


def test_a_photo_that_was_taken_while_the_board_moved_is_named(rng):
    """Its lower rows are seen some milliseconds later than the upper ones, from elsewhere, and all are blurred."""
    poses = poses_before(LENS, 14, rng)
    moved = Rigid3(Rotation3.exp(np.array([0.02, -0.01, 0.03])), np.array([0.004, 0.001, 0.002])) @ poses[6]
    views, later = seen(LENS, BOARD, poses, rng), seen(LENS, BOARD, [*poses[:6], moved], rng, 0.5)[6]
    common = np.intersect1d(views[6].corner_ids, later.corner_ids)
    at = [np.searchsorted(view.corner_ids, common) for view in (views[6], later)]
    points2D = np.where(common[:, None] < 27, views[6].points2D[at[0]], later.points2D[at[1]])
    views[6] = dataclasses.replace(views[6], corner_ids=common, points2D=points2D)
    found = calibrated(views, CalibrationConfig(lens="opencv4"))
    assert [(view.name, view.reason) for view in found.rejected_views] == [("view06", "outlier_view")]
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)


def test_one_corner_that_is_a_pixel_off_is_left_out_alone(rng):
    views = views_of(LENS, rng)
    points2D = np.array(views[7].points2D)
    points2D[20] += [0.8, -0.6]
    views[7] = with_corners(views[7], points2D)
    found = calibrated(views, CalibrationConfig(lens="opencv4"))
    assert found.rejected_corners == (("view07", int(views[7].corner_ids[20])),)
    assert not found.rejected_views


@pytest.mark.parametrize("shape", ["flat", "free"])
def test_a_photo_that_is_a_little_worse_than_very_good_ones_stays(shape, rng):
    poses = poses_before(LENS, 14, rng, reach=0.15)
    views = [*seen(LENS, BOARD, poses[:-1], rng, 0.05), *seen(LENS, BOARD, poses, rng, 0.15)[-1:]]
    found = calibrated(views, CalibrationConfig(lens="opencv4", shape=shape))
    assert found.rejected_views == ()
    assert len(found.rejected_corners) <= 1


def test_photos_of_different_sharpness_keep_their_corners(rng):
    """By one measure for all, a twentieth of these corners would be beyond four standard deviations."""
    poses = poses_before(LENS, 16, rng)
    views = [
        seen(LENS, BOARD, [pose], rng, noise)[0] for pose, noise in zip(poses, [0.03] * 10 + [0.1] * 6, strict=True)
    ]
    views = [dataclasses.replace(view, name=f"{v}") for v, view in enumerate(views)]
    found = calibrated(views, CalibrationConfig(lens="opencv4"))
    lengths = np.hypot(*found.residuals.T)
    assert np.mean(lengths > 4 * np.median(lengths) / 1.177) > 0.02
    assert len(found.rejected_corners) <= 1


def test_a_view_of_which_most_is_wrong_is_left_out(rng):
    views = views_of(LENS, rng)
    views[2] = spoilt(views[2], rng, int(0.6 * len(views[2].corner_ids)), 15.0)
    found = calibrated(views, CalibrationConfig(lens="opencv4"))
    assert [view.name for view in found.rejected_views] == ["view02"]
    assert "px off" in found.rejected_views[0].detail


SWAPPED = np.arange(54).reshape(9, 6).T.ravel()
MIRRORED = np.arange(54).reshape(6, 9)[:, ::-1].ravel()


@pytest.mark.parametrize(("order", "reason"), [(SWAPPED, "not_this_board"), (MIRRORED, "mirrored")])
def test_a_view_with_corners_in_another_order_is_named(order, reason, rng):
    views = views_of(LENS, rng)
    views[3] = dataclasses.replace(views[3], corner_ids=order[views[3].corner_ids])
    found = calibrated(views)
    assert [(view.name, view.reason) for view in found.rejected_views] == [("view03", reason)]


def test_views_of_another_size_are_named(rng):
    views = views_of(LENS, rng)
    views[:4] = [dataclasses.replace(view, width=960, height=1280) for view in views[:4]]
    found = calibrated(views)
    assert [view.reason for view in found.rejected_views] == ["other_size"] * 4
    assert found.camera.width == 1280


# --- what it refuses ----------------------------------------------------------------------------------------------


def boards_at(camera, rng, turns, noise_px):
    poses = [
        Rigid3(Rotation3.exp(np.array(turn)), np.append(rng.uniform(-0.08, 0.08, 2), rng.uniform(0.4, 0.8)))
        for turn in turns
    ]
    return seen(camera, BOARD, poses, rng, noise_px)


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
@pytest.mark.parametrize("lens", ["pinhole", "opencv4", "opencv5", "fisheye"])
def test_boards_parallel_to_the_image_are_refused(lens, noise_px, rng):
    views = boards_at(LENS if lens != "pinhole" else PINHOLE, rng, [(0.0, 0.0, a) for a in range(10)], noise_px)
    reason = refused(views, CalibrationConfig(lens=lens))
    assert reason.reason == "undetermined_focal"
    assert "image plane" in reason.detail


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
@pytest.mark.parametrize(("camera", "lens"), [(PINHOLE, "pinhole"), (LENS, "opencv4")])
def test_boards_parallel_to_one_another_are_a_fallback_in_words(camera, lens, noise_px, rng):
    views = boards_at(camera, rng, [(0.5, 0.3, 0.0)] * 10, noise_px)
    found = calibrated(views, CalibrationConfig(lens=lens))
    assert any("parallel" in words for words in found.fallbacks)
    assert abs(found.camera.mean_focal_length / camera.mean_focal_length - 1) < 0.1


def test_boards_tilted_about_one_axis_are_told(rng):
    views = boards_at(LENS, rng, [(a, 0.0, 0.0) for a in np.linspace(-0.7, 0.7, 10)], 0.1)
    assert any("one axis" in words for words in calibrated(views).fallbacks)


def test_views_in_general_position_have_no_fallback(rng):
    assert calibrated(views_of(LENS, rng)).fallbacks == ()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views_are_refused(count, rng):
    reason = refused(views_of(LENS, rng, count=count))
    assert reason.reason == "too_few_views"
    assert reason.detail == f"{count} of 3 needed"


def test_rows_and_columns_that_are_swapped_everywhere_are_refused(rng):
    views = [dataclasses.replace(v, corner_ids=SWAPPED[v.corner_ids]) for v in views_of(LENS, rng)]
    reason = refused(views, CalibrationConfig())
    assert reason.reason == "too_few_views"
    assert "rows and columns swapped" in reason.detail


def test_mistakes_of_the_caller_are_told(rng):
    views = views_of(LENS, rng)
    with pytest.raises(ValueError, match="unknown lens model 'thick'"):
        calibrate(BOARD, views, CalibrationConfig(lens="thick"))
    with pytest.raises(ValueError, match="of a board of 10"):
        calibrate(BOARD[:10].copy(), views)
    with pytest.raises(ValueError, match="z = 0"):
        calibrate(BOARD + 1.0, views)
    with pytest.raises(ValueError, match="twice"):
        BoardView("v", 10, 10, np.zeros(2, np.int64), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="positive definite"):
        BoardView("v", 10, 10, np.arange(1), np.zeros((1, 2)), np.zeros((1, 2, 2)))


def test_the_division_model_is_the_unified_one_with_half(rng):
    camera = Camera("EUCM", 1280, 960, np.array([700.0, 698.0, 634.0, 485.0, 0.5, 0.8]))
    pixels = rng.uniform(0, 1, (50, 2)) * [1280, 960]
    rays, _ = camera.unproject(pixels)
    a, b = ((pixels - [634.0, 485.0]) / [700.0, 698.0]).T
    divided = np.stack([a, b, 1 - 0.8 / 4 * (a * a + b * b)], 1)
    np.testing.assert_allclose(rays, divided / np.linalg.norm(divided, axis=1, keepdims=True), atol=1e-12)
    found = calibrated(views_of(camera, rng, noise_px=0.0), CalibrationConfig(lens="division"))
    np.testing.assert_allclose(found.camera.params, camera.params, rtol=1e-6)
    assert "alpha" not in found.free_names


def test_a_view_that_is_tilted_the_wrong_way_is_turned_back(rng):
    from calib.refine_fit import Fit, turned_back
    from calib.refine_lenses import lens_by_name
    from calib.refine_system import CalibrationSystem
    from calib.zhang import Start

    found = calibrated(views_of(LENS, rng))
    R, t = found.estimate.rotations.copy(), found.estimate.translations.copy()
    sight = t[5] / np.linalg.norm(t[5])  # the board's middle is its origin
    R[5] = (2 * np.outer(sight, sight) - np.eye(3)) @ R[5] @ np.diag([-1.0, -1.0, 1.0])
    flipped = dataclasses.replace(found.estimate, rotations=R)
    system = CalibrationSystem(found.observations, flipped, found.columns)
    turned = turned_back(Fit(lens_by_name("opencv4"), ALL, Start(found.camera, "given"), found.shape), system)
    assert turned is not None
    np.testing.assert_allclose(turned.rotations, found.estimate.rotations, atol=1e-3)
    np.testing.assert_allclose(turned.translations, found.estimate.translations, atol=1e-4)


def test_copies_of_a_photo_count_once_and_are_named(rng):
    views = views_of(LENS, rng)
    copies = [dataclasses.replace(views[k], name=f"copy{k}") for k in (3, 3, 5)]
    copies[1] = dataclasses.replace(copies[1], name="again3")
    found = calibrated([*copies[:1], *views, *copies[1:]])
    plain = calibrated(views)
    assert found.cost == pytest.approx(plain.cost, rel=1e-12)
    assert [(view.name, view.reason) for view in found.rejected_views] == [
        ("view03", "copy_of copy3"), ("again3", "copy_of copy3"), ("copy5", "copy_of view05"),
    ]  # fmt: skip
    np.testing.assert_allclose(found.camera.params, plain.camera.params, rtol=1e-6)


def test_eight_copies_of_one_photo_are_one_photo(rng):
    view = views_of(LENS, rng)[0]
    why = refused([dataclasses.replace(view, name=f"{k}") for k in range(8)])
    assert why.reason == "too_few_views"
    assert why.detail.startswith("1 of 3 needed (1: copy_of 0")


@pytest.mark.parametrize(("angle_deg", "distance"), [(30.0, 0.06), (45.0, 0.04), (60.0, 0.06)])
def test_a_board_close_to_a_fisheye_is_a_board_though_nothing_in_its_image_is_flat(angle_deg, distance):
    wide = Camera("OPENCV_FISHEYE", 512, 512, np.array([191.0, 191, 255, 257, 0.0033, 0.0008, -0.0021, 0.0002]))
    angle, board = np.radians(angle_deg), flat_board()
    ray = np.array([0.8 * np.sin(angle), 0.6 * np.sin(angle), np.cos(angle)])
    facing = Rotation3.exp(np.array([-ray[1], ray[0], 0.0]) / np.sin(angle) * angle)
    close = Rigid3(facing @ Rotation3.exp(np.array([0.2, -0.9, 0.3])), distance * ray)
    rng = np.random.default_rng(0)
    views = seen(wide, board, [*poses_before(wide, 10, rng), close], rng, 0.03)
    for reject in (True, False):
        found = calibrate(board, views, CalibrationConfig(lens="fisheye", reject=reject))
        assert isinstance(found, Calibration)
        assert not found.rejected_views
        assert found.rms_px < 0.05

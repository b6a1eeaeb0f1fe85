"""Calibration of rigs beside OpenCV's on the same corners: cost, time, baseline; then trials against the truth.

    python -m scripts.bench_calib_rigs sets DATA [--json FILE]      # DATA is the folder of boards
    python -m scripts.bench_calib_rigs trials [--count 200]
    python -m scripts.bench_calib_rigs handeye [--count 200]

Corners are found by OpenCV's detector and refined with a window of 0.35 of the smallest spacing in the photo; frames in
which both cameras show the whole board are taken. They are rounded to 24 bits for both programs, since OpenCV takes no
others, a pixel of one camera weighs as one of the other, and nothing is rejected. OpenCV's three functions return an
RMS each of their own: of points over both cameras. Here all is compared as the cost ½ Σ r² of the parameters that a
program returns, evaluated by one piece of code with the boards' poses fitted to them. Times are of one thread, medians
in one process: `calibrate_rig` (with each camera's own calibration) beside `calibrateCamera` twice and then
`stereoCalibrate`, or `calibrateMultiview`, which calibrates the cameras itself.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib import boards
from calib.board_turns import board_turns
from calib.hand_eye import calibrate_hand_eye
from calib.hand_eye_start import closed_form, pairs_of
from calib.refine_fit import CalibrationConfig
from calib.refine_views import BoardView
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_alone import camera_alone
from calib.rig_epipolar import epipolar_errors
from calib.rig_system import RigSystem
from calib.rig_uncertainty import hold_out_frames, relative_uncertainty, rig_covariance
from calib.rig_views import RigCamera, RigObservations
from scripts.bench_calib import chessboard, corners, rounded, timed
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

SETS: dict[str, tuple[str, tuple[int, int], float, float | None]] = {
    "lr14": ("opencv_stereo_lr14", (9, 6), 0.025, None),
    "bumblebee": ("boofcv_stereo_Bumblebee2_Chess", (6, 4), 0.03, 0.12004),
}
"""Folder, inner corners, square in metres, and the baseline where somebody else has found one."""
TIGHT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12)
FLAGS = {"opencv4": cv2.CALIB_FIX_K3, "opencv5": 0, "opencv8": cv2.CALIB_RATIONAL_MODEL}
PLAIN = RigConfig(weigh_cameras=False, reject=False, keep_invertible=False)
NONE = np.zeros(0, np.int64)


def main() -> int:
    cv2.setNumThreads(1)
    options = parse_options()
    parts = {"sets": sets, "trials": trials, "handeye": hand_eye}
    rows = list(parts[options.part](options))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("sets", "trials", "handeye"))
    parser.add_argument("data", type=Path, nargs="?", default=Path(), help="folder of the sets")
    parser.add_argument("--count", type=int, default=200, help="number of trials")
    parser.add_argument("--repeats", type=int, default=5, help="runs that a time is the median of")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


def told(row: dict[str, Any]) -> dict[str, Any]:
    print({k: float(f"{v:.12g}") if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row


# --- real sets ----------------------------------------------------------------------------------------------------


def sets(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for name, (folder, size, square, known) in SETS.items():
        board = chessboard(size, square)
        pair = common_views(options.data / folder, size)
        if sum(size) % 2 == 0:
            raw = stereo(board, pair, "opencv5", "free")[0]
            pair = same_end(board, pair, size, square)
            yield told({"set": name, "opencv_rms_of_corners_as_found": raw})
        for lens in FLAGS:
            for mode in ("fixed", "free"):
                yield told({"set": name, "lens": lens, "mode": mode} | beside(board, pair, lens, mode, options.repeats))
            yield told({"set": name, "lens": lens, "mode": "multiview"} | multiview(board, pair, lens, options.repeats))
        yield told({"set": name, "mode": "fisheye and opencv5"} | registered(board, pair))
        yield told({"set": name} | honest(board, pair, known))


def common_views(folder: Path, size: tuple[int, int]) -> list[list[BoardView]]:
    """Views of the left and of the right camera, of the frames in which both show the board."""
    sides = []
    for side in ("left", "right"):
        views = rounded(list(corners(folder, f"{side}*.jpg", size)))
        sides.append({view.name.removeprefix(side).removesuffix(".jpg"): view for view in views})
    shared = sorted(sides[0].keys() & sides[1].keys())
    return [[side[frame] for frame in shared] for side in sides]


def same_end(
    board: np.ndarray, pair: list[list[BoardView]], size: tuple[int, int], square: float
) -> list[list[BoardView]]:
    """Views whose corners start at the same end of the board; a board with even sides has two alike."""
    turns = board_turns(boards.chessboard(*size, square))
    found = calibrate_rig(board, rig_cameras(pair, "opencv5", "opencv5"), dataclasses.replace(PLAIN), turns=turns)
    assert isinstance(found, RigCalibration), found
    return [
        [
            dataclasses.replace(view, points2D=view.points2D[::-1]) if f"{f:02d}" in turned else view
            for f, view in enumerate(views)
        ]
        for views, turned in zip(pair, found.turned, strict=True)
    ]


def rig_cameras(pair: list[list[BoardView]], *lenses: str) -> list[RigCamera]:
    frames = tuple(f"{f:02d}" for f in range(len(pair[0])))
    return [
        RigCamera(name, tuple(views), frames, lens)
        for name, views, lens in zip(("left", "right"), pair, lenses, strict=True)
    ]


def beside(board: np.ndarray, pair: list[list[BoardView]], lens: str, mode: str, repeats: int) -> dict[str, Any]:
    """Ours and `stereoCalibrate`, each after both cameras alone."""
    config = dataclasses.replace(PLAIN, refine_intrinsics=mode == "free")
    seen = rig_cameras(pair, lens, lens)
    ours, our_ms = timed(lambda: calibrate_rig(board, seen, config), repeats)
    theirs, their_ms = timed(lambda: stereo(board, pair, lens, mode), repeats)
    assert isinstance(ours, RigCalibration), ours
    if mode == "fixed":  # from the very same cameras, or the costs are of different problems
        ours = from_their_cameras(board, pair, theirs[1], theirs[2])
    return compared(ours, theirs[0], cost_of(ours, theirs[1], theirs[2], theirs[3]), our_ms, their_ms)


def compared(
    ours: RigCalibration, their_rms: float, their_cost: float, our_ms: float, their_ms: float
) -> dict[str, Any]:
    return {
        "frames": len(ours.observations.frames),
        "rms": ours.rms_px,
        "opencv_says": their_rms,
        "opencv_rms": np.sqrt(2 * their_cost / ours.observations.corner_count),
        "cost_ratio_less_1": ours.cost / their_cost - 1,
        "converged": ours.converged,
        "iterations": ours.iterations,
        "ours_ms": our_ms,
        "opencv_ms": their_ms,
        "times_faster": their_ms / our_ms,
        "baseline_mm": 1e3 * float(np.linalg.norm(ours.cams_from_rig[1].translation)),
    }


def from_their_cameras(board: np.ndarray, pair: list[list[BoardView]], left: Camera, right: Camera) -> RigCalibration:
    lens = "opencv8" if left.model == "FULL_OPENCV" else "opencv4"
    seen = [
        dataclasses.replace(one, camera=camera)
        for one, camera in zip(rig_cameras(pair, lens, lens), (left, right), strict=True)
    ]
    found = calibrate_rig(board, seen, PLAIN)
    assert isinstance(found, RigCalibration), found
    return found


def stereo(
    board: np.ndarray, pair: list[list[BoardView]], lens: str, mode: str
) -> tuple[float, Camera, Camera, Rigid3]:
    """OpenCV's RMS, cameras and the motion from left to right."""
    points3D = [board.astype(np.float32)] * len(pair[0])
    seen = [[(v.points2D - 0.5).astype(np.float32).reshape(-1, 1, 2) for v in views] for views in pair]
    size = (pair[0][0].width, pair[0][0].height)
    flags, alone = FLAGS[lens], []
    for points2D in seen:
        alone += cv2.calibrateCamera(points3D, points2D, size, np.eye(3), np.zeros(8), flags=flags, criteria=TIGHT)[1:3]
    flags |= cv2.CALIB_FIX_INTRINSIC if mode == "fixed" else cv2.CALIB_USE_INTRINSIC_GUESS
    (K1, D1, K2, D2), (seen1, seen2) = (np.array(one) for one in alone), seen
    rms, K1, D1, K2, D2, R, t, *_ = cv2.stereoCalibrate(
        points3D, seen1, seen2, K1, D1, K2, D2, size, flags=flags, criteria=TIGHT
    )
    return rms, theirs_as_camera(K1, D1, size), theirs_as_camera(K2, D2, size), pose(R, t)


def pose(R: np.ndarray, t: np.ndarray) -> Rigid3:
    return Rigid3(Rotation3.from_matrix(np.asarray(R)), np.asarray(t, float).ravel())


def theirs_as_camera(K: np.ndarray, D: np.ndarray, size: tuple[int, int], wide: bool = False) -> Camera:
    """With the half pixel between the conventions."""
    d = np.zeros(12)
    d[: min(np.size(D), 12)] = np.ravel(D)[:12]
    start = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]
    if wide:
        return Camera("OPENCV_FISHEYE", *size, np.array([*start, *d[:4]]))
    return Camera("FULL_OPENCV", *size, np.array([*start, *d[:8]]))


def cost_of(ours: RigCalibration, left: Camera, right: Camera, motion: Rigid3) -> float:
    """½ Σ r² of other cameras and mounts on the corners of a rig, with the frames' poses fitted to them."""
    return fitted_cost(ours.observations, dataclasses.replace(
        ours.estimate,
        cameras=(left, right),
        mount_rotations=np.stack([np.eye(3), motion.rotation.matrix]),
        mount_translations=np.stack([np.zeros(3), motion.translation]),
    ))  # fmt: skip


def fitted_cost(observations: RigObservations, estimate: Any) -> float:
    system = RigSystem(observations, estimate, [NONE, NONE], free_mounts=False, keep_invertible=False, caution=1e-6)
    rules = StopRules(max_iterations=200, relative_cost_tolerance=1e-14, gradient_tolerance=0.0)
    return minimize(system, rules).final_cost


def multiview(board: np.ndarray, pair: list[list[BoardView]], lens: str, repeats: int) -> dict[str, Any]:
    """Ours and `calibrateMultiview`, which is asked for everything at once."""
    frames, size = len(pair[0]), (pair[0][0].width, pair[0][0].height)
    points2D = [[(v.points2D - 0.5).astype(np.float32) for v in views] for views in pair]

    def call() -> Any:
        # They are filled, so that none may be another's.
        empty = ([np.zeros(shape) for _ in pair] for shape in ((3, 3), 8, (3, 3), 3))
        return cv2.calibrateMultiview(
            [board.astype(np.float32)] * frames, points2D, [size] * 2, np.full((2, frames), 255, np.uint8),
            np.zeros(2, np.uint8), *empty, flagsForIntrinsics=np.full(2, FLAGS[lens], np.int32), criteria=TIGHT,
        )  # fmt: skip

    try:
        (rms, Ks, Ds, Rs, Ts), their_ms = timed(call, max(repeats // 2, 1))
    except cv2.error as error:
        return {"opencv": str(error).splitlines()[0][:160]}
    ours, our_ms = timed(lambda: calibrate_rig(board, rig_cameras(pair, lens, lens), PLAIN), repeats)
    assert isinstance(ours, RigCalibration), ours
    R = np.asarray(Rs[1], float)
    motion = pose(R if R.size == 9 else cv2.Rodrigues(R)[0], Ts[1])
    cost = cost_of(ours, theirs_as_camera(Ks[0], Ds[0], size), theirs_as_camera(Ks[1], Ds[1], size), motion)
    return compared(ours, rms, cost, our_ms, their_ms)


def registered(board: np.ndarray, pair: list[list[BoardView]]) -> dict[str, Any]:
    """`registerCameras` with a fisheye model on the left and a perspective one on the right, intrinsics held."""
    alone = [
        camera_alone(board, one, dataclasses.replace(CalibrationConfig(), reject=False, keep_invertible=False), False)
        for one in rig_cameras(pair, "fisheye", "opencv5")
    ]
    left, right = (one.camera for one in alone if not isinstance(one, Rejected))
    seen = [dataclasses.replace(one, camera=camera) for one, camera in zip(
        rig_cameras(pair, "fisheye", "opencv5"), (left, right), strict=True)]  # fmt: skip
    ours = calibrate_rig(board, seen, PLAIN)
    assert isinstance(ours, RigCalibration), ours
    points3D = [board.astype(np.float32)] * len(pair[0])
    seen1, seen2 = ([(v.points2D - 0.5).astype(np.float32) for v in views] for views in pair)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    try:
        rms, R, t, *_ = cv2.registerCameras(
            points3D, points3D, seen1, seen2, left.calibration_matrix - half, left.params[4:8].copy(),
            cv2.CALIB_MODEL_FISHEYE, right.calibration_matrix - half, right.params[4:].copy(),
            cv2.CALIB_MODEL_PINHOLE, np.eye(3), np.zeros(3), criteria=TIGHT,
        )  # fmt: skip
    except cv2.error as error:
        return {"rms": ours.rms_px, "opencv": str(error).splitlines()[0][:160]}
    return compared(ours, rms, cost_of(ours, left, right, pose(R, t)), np.nan, np.nan)


def honest(board: np.ndarray, pair: list[list[BoardView]], known: float | None) -> dict[str, Any]:
    """What Parallax says by default, with its doubts."""
    found = calibrate_rig(board, rig_cameras(pair, "opencv5", "opencv5"))
    assert isinstance(found, RigCalibration), found
    row: dict[str, Any] = {"mode": "default", "rms": found.rms_px, "known_mm": known and 1e3 * known}
    for by_frame, name in ((False, "sigma_mm"), (True, "sigma_by_frame_mm")):
        covariances = rig_covariance(found, by_frame=by_frame)
        assert not isinstance(covariances, Rejected), covariances
        relative = relative_uncertainty(found, covariances, 0, 1)
        row |= {"baseline_mm": 1e3 * relative.baseline, name: 1e3 * relative.sigma_baseline}
    held = hold_out_frames(found, rng=np.random.default_rng(0))
    errors = epipolar_errors(found, 0, 1)
    assert not isinstance(held, Rejected), held
    assert errors is not None
    row |= {"holdout_rms": held.rms_px, "training_rms": held.training_rms_px}
    return row | {"epipolar_px": errors.rms_px, "vertical_px": errors.vertical_px}


# --- trials -------------------------------------------------------------------------------------------------------

LEFT = Camera("OPENCV", 1280, 960, np.array([1050.0, 1043.0, 651.0, 468.0, -0.21, 0.09, 0.0006, -0.0004]))
RIGHT = Camera("OPENCV", 1280, 960, np.array([1061.0, 1055.0, 633.0, 489.0, -0.19, 0.07, -0.0003, 0.0005]))
WIDE = Camera("OPENCV_FISHEYE", 1280, 960, np.array([420.0, 418.0, 634.0, 485.0, 0.03, -0.008, 0.004, -0.001]))
RIGS = {
    "stereo": ((LEFT, RIGHT), ((0, 0, 0, 0, 0, 0), (0.02, -0.05, 0.01, -0.12, 0.001, 0.004))),
    "three, one wide": (
        (LEFT, RIGHT, WIDE),
        ((0, 0, 0, 0, 0, 0), (0.02, -0.05, 0.01, -0.12, 0.001, 0.004), (-0.3, 0.1, 0.02, 0.05, -0.08, 0.02)),
    ),
}
LENSES = {"OPENCV": "opencv4", "OPENCV_FISHEYE": "fisheye"}


def trials(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Boards before known rigs, other poses and noise in every trial; a quarter of the views are not there."""
    for name, (cameras, tangents) in RIGS.items():
        mounts = [Rigid3.exp(np.array(tangent, float)) for tangent in tangents]
        for mode in ("free", "fixed", "unlike"):
            yield told({"rig": name, "mode": mode, **judged(cameras, mounts, mode, options.count)})


def judged(cameras: tuple[Camera, ...], mounts: list[Rigid3], mode: str, count: int) -> dict[str, Any]:
    """Parts of mounts and baselines within three sigma; ratios of predicted to true errors."""
    board = chessboard((9, 6), 0.03)
    board -= (board.min(0) + board.max(0)) / 2
    errors, sigmas, failed = [], [], 0
    for trial in range(count):
        rng = np.random.default_rng(trial)
        seen = rendered(cameras, mounts, board, rng, cameras if mode == "fixed" else None, mode == "unlike")
        found = calibrate_rig(board, seen, RigConfig(reject=False))
        covariances = found if isinstance(found, Rejected) else rig_covariance(found)
        if isinstance(found, Rejected) or isinstance(covariances, Rejected):
            failed += 1
            continue
        error, sigma = [], []
        for c in range(1, len(cameras)):
            relative = relative_uncertainty(found, covariances, 0, c)
            apart = relative.cam2_from_cam1 @ mounts[c].inverse()
            error += [
                *apart.rotation.log(),
                *apart.translation,
                relative.baseline - np.linalg.norm(mounts[c].translation),
            ]
            sigma += [*np.sqrt(np.diag(relative.covariance)), relative.sigma_baseline]
        errors.append(error)
        sigmas.append(sigma)
    ratio = np.sqrt(np.mean(np.square(sigmas), 0) / np.mean(np.square(errors), 0))
    within = np.abs(errors) < 3 * np.array(sigmas)
    return {
        "trials": count,
        "failed": failed,
        "within_3_sigma": float(np.mean(within)),
        "predicted_over_true": [float(f"{r:.3f}") for r in ratio],
    }


def rendered(
    cameras: tuple[Camera, ...], mounts: list[Rigid3], board: np.ndarray, rng: np.random.Generator,
    known: tuple[Camera, ...] | None, unlike: bool,
) -> list[RigCamera]:  # fmt: skip
    """Twenty frames before the rig, noise of 0.1 px; each camera misses some of them.

    Args:
        unlike: corners of boards that are far or slanted err by up to three times as much as others, 0.06 to 0.18 px.
    """
    views: list[list[BoardView]] = [[] for _ in cameras]
    frames: list[list[str]] = [[] for _ in cameras]
    for f in range(20):
        middle = np.append(rng.uniform(-0.25, 0.25, 2), 1.0) * rng.uniform(0.4, 0.8)
        turn = Rotation3.exp(np.append(rng.uniform(-0.6, 0.6, 2), 0.0)) @ Rotation3.exp(
            np.array([0, 0, rng.uniform(-1, 1)])
        )
        rig_from_board = Rigid3(turn, middle)
        for c, camera in enumerate(cameras):
            pose = mounts[c] @ rig_from_board
            pixels, valid = camera.project(pose @ board)
            ids = np.flatnonzero(valid & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1))
            if len(ids) < 12 or (f + c) % 4 == 0:
                continue
            smaller = np.linalg.norm(pose.translation) / 0.45 / pose.rotation.matrix[2, 2] ** 2
            noise = 0.06 * np.clip(smaller, 1, 3) if unlike else 0.1
            noisy = pixels[ids] + noise * rng.normal(size=(len(ids), 2))
            views[c].append(BoardView(f"{c}-{f:02d}", camera.width, camera.height, ids, noisy))
            frames[c].append(f"{f:02d}")
    return [
        RigCamera(f"cam{c}", tuple(views[c]), tuple(frames[c]), LENSES[camera.model], known[c] if known else None)
        for c, camera in enumerate(cameras)
    ]


# --- hand and eye -------------------------------------------------------------------------------------------------

ROBOTS = {"exact": (0.0, 0.0), "fine": (1e-4, 5e-5), "usual": (1e-3, 3e-4)}
"""Standard deviations of a robot, radians and metres on each axis."""
HAND_FROM_CAM = Rigid3.exp(np.array([0.05, -0.4, 1.2, 0.03, -0.06, 0.11]))
BASE_FROM_BOARD = Rigid3.exp(np.array([2.9, 0.2, -0.1, 0.6, 0.1, 0.02]))


def hand_eye(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A camera on robots of several kinds: errors of closed forms and of ours, and whether it knows its own."""
    for robot, sigma in ROBOTS.items():
        for count in (8, 15, 30):
            yield told({"robot": robot, "poses": count, **hand_eye_judged(sigma, count, options.count)})


def hand_eye_judged(sigma: tuple[float, float], count: int, trials: int) -> dict[str, Any]:
    """Rms errors, radians and mm; ratios of predicted to true errors."""
    board = chessboard((9, 6), 0.03)
    board -= (board.min(0) + board.max(0)) / 2
    forms = {"ours closed": closed_form, "daniilidis": daniilidis, "shah": shah}
    errors: dict[str, list[np.ndarray]] = {name: [] for name in (*forms, "ours")}
    sigmas, failed = [], 0
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        views, poses = [], []
        while len(views) < count:
            turn = Rotation3.exp(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-1, 1)))
            pose = Rigid3(turn, np.append(rng.uniform(-0.1, 0.1, 2), rng.uniform(0.4, 0.7)))
            pixels, valid = LEFT.project(pose @ board)
            ids = np.flatnonzero(valid & np.all((pixels > 0) & (pixels < [LEFT.width, LEFT.height]), axis=1))
            if len(ids) >= 20:
                noisy = pixels[ids] + 0.1 * rng.normal(size=(len(ids), 2))
                views.append(BoardView(f"{len(views)}", LEFT.width, LEFT.height, ids, noisy))
                off = Rigid3(Rotation3.exp(sigma[0] * rng.normal(size=3)), sigma[1] * rng.normal(size=3))
                poses.append(BASE_FROM_BOARD @ pose.inverse() @ HAND_FROM_CAM.inverse() @ off)
        hands, names = Rigid3.stack(poses), tuple(view.name for view in views)
        alone = camera_alone(board, RigCamera("c", tuple(views), names, "opencv4", LEFT), CalibrationConfig(), False)
        found = calibrate_hand_eye(board, views, hands, LEFT)
        if isinstance(found, Rejected) or isinstance(alone, Rejected):
            failed += 1
            continue
        for name, form in forms.items():
            errors[name].append(hand_eye_error(form(hands.inverse(), alone.cams_from_board)[0].inverse()))
        errors["ours"].append(hand_eye_error(found.mount_from_cam))
        sigmas.append(np.append(found.sigma_rotation, found.sigma_position))
    row: dict[str, Any] = {"trials": trials, "failed": failed}
    for name, off in errors.items():
        square = np.mean(np.square(off), 0)
        row[name] = [float(f"{np.sqrt(square[:3].sum()):.3g}"), float(f"{1e3 * np.sqrt(square[3:].sum()):.3g}")]
    known = np.array(errors["ours"])
    row["within_3_sigma"] = float(np.mean(np.abs(known) < 3 * np.array(sigmas)))
    ratio = np.sqrt(np.mean(np.square(sigmas), 0) / np.mean(known**2, 0))
    return row | {"predicted_over_true": [float(f"{r:.3f}") for r in ratio]}


def hand_eye_error(hand_from_cam: Rigid3) -> np.ndarray:
    turn = (hand_from_cam.rotation.inverse() @ HAND_FROM_CAM.rotation).log()
    return np.append(turn, hand_from_cam.translation - HAND_FROM_CAM.translation)


def daniilidis(mounts: Rigid3, cams: Rigid3) -> tuple[Rigid3, None]:
    """A rival, by dual quaternions (IJRR 1999): the null space of the screws' vector equations."""
    i, j = pairs_of(len(mounts))
    rows = []
    A, B = mounts[j] @ mounts[i].inverse(), cams[j] @ cams[i].inverse()
    for k in range(len(A)):
        (a, ad), (b, bd) = dual(A[k]), dual(B[k])
        top = np.concatenate([(b - a)[1:, None], skew((a + b)[1:]), np.zeros((3, 4))], axis=1)
        low = np.concatenate([(bd - ad)[1:, None], skew((ad + bd)[1:]), (b - a)[1:, None], skew((a + b)[1:])], axis=1)
        rows += [top, low]
    u, v = np.linalg.svd(np.concatenate(rows))[2][-2:]
    # λ₁ u + λ₂ v with |q| = 1 and q · q' = 0.
    uu, uv, vv = u[:4] @ u[4:], u[:4] @ v[4:] + v[:4] @ u[4:], v[:4] @ v[4:]
    roots = np.real(np.roots([uu, uv, vv]))
    best = max(roots, key=lambda s: s * s * u[:4] @ u[:4] + 2 * s * u[:4] @ v[:4] + v[:4] @ v[:4])
    q = best * u + v
    q = q / np.linalg.norm(q[:4])
    turn = Rotation3(q[:4])
    return Rigid3(turn, 2 * product(q[4:], q[:4] * [1, -1, -1, -1])[1:]), None


def dual(motion: Rigid3) -> tuple[np.ndarray, np.ndarray]:
    q = np.array(motion.rotation.wxyz)
    q = q if q[0] > 0 else -q
    return q, 0.5 * product(np.append(0.0, motion.translation), q)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.append(p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))


def shah(mounts: Rigid3, cams: Rigid3) -> tuple[Rigid3, Rigid3]:
    """A rival, linear in both unknowns at once (J. Mechanisms and Robotics 2013): C_k = X G_k Z."""
    G, C = mounts.rotation.matrix, cams.rotation.matrix
    # G Z = X⁻¹ C: the columns of R_Z and of R_X⁻¹, one below the other, are a pair of singular vectors.
    U, _, Vt = np.linalg.svd(np.sum([np.kron(c, g) for c, g in zip(C, G, strict=True)], axis=0))
    RZ, inverse = (rotation_of(vector.reshape(3, 3).T) for vector in (Vt[0], U[:, 0]))
    RX = inverse.T
    left = np.concatenate([np.broadcast_to(np.eye(3), G.shape), RX @ G], axis=2).reshape(-1, 6)
    right = (cams.translation - mounts.translation @ RX.T).ravel()
    t = np.linalg.lstsq(left, right, rcond=None)[0]
    return Rigid3(Rotation3.from_matrix(RX), t[:3]), Rigid3(Rotation3.from_matrix(RZ), t[3:])


def rotation_of(matrix: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return U @ Vt


if __name__ == "__main__":
    sys.exit(main())

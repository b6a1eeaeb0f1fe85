"""Calibration beside OpenCV's on the same corners: cost, time, standard deviations; then trials against the truth.

    python -m scripts.bench_calib sets DATA [--json FILE]      # DATA is the folder of boards
    python -m scripts.bench_calib trials [--count 200]

Corners are found by OpenCV's detector and refined with a window of 0.35 of the smallest spacing in the photo. They are
rounded to 24 bits for both programs, since OpenCV takes no others. OpenCV runs with 500 iterations and 1e-12, and
Parallax need not keep distortion invertible, so that both minimise the same. Times are of one thread, medians in one
process, of `calibrateCamera` without standard deviations, which ours computes beside: `ours_all_ms` has the covariances
of everything, `opencv_all_ms` is of `calibrateCameraExtended`. `sigma_mismatch` is the largest difference of standard
deviations from OpenCV's, over these, `sigma_error` from those of a QR decomposition of the Jacobian: where coefficients
are nearly undetermined OpenCV's are too small. "repeated" sets are the same views again and again to
200, with more noise of 0.05 px, to show how time grows.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from calib.uncertainty import covariance
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

SETS: dict[str, tuple[str, str, tuple[int, int], float]] = {
    "left": ("opencv_stereo_lr14", "left*.jpg", (9, 6), 1.0),
    "right": ("opencv_stereo_lr14", "right*.jpg", (9, 6), 1.0),
    "sony": ("boofcv_mono_Sony_DSC-HX5V_Chess", "*.jpg", (6, 4), 0.03),
    "bumblebee": ("boofcv_stereo_Bumblebee2_Chess", "left*.jpg", (6, 4), 0.03),
    "carnd": ("carnd_camera_cal", "*.jpg", (9, 6), 1.0),
}
TIGHT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12)
FLAGS = {
    "opencv4": cv2.CALIB_FIX_K3,
    "opencv5": 0,
    "opencv8": cv2.CALIB_RATIONAL_MODEL,
    "opencv12": cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    "fisheye": cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
}


def main() -> int:
    cv2.setNumThreads(1)
    options = parse_options()
    rows = list(sets(options) if options.part == "sets" else trials(options))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("sets", "trials"))
    parser.add_argument("data", type=Path, nargs="?", default=Path(), help="folder of the sets")
    parser.add_argument("--count", type=int, default=200, help="number of trials")
    parser.add_argument("--repeats", type=int, default=9, help="runs that a time is the median of")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


# --- real sets ----------------------------------------------------------------------------------------------------


def corners(folder: Path, pattern: str, size: tuple[int, int]) -> Iterator[BoardView]:
    """The views of a set in which the whole board is found."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for file in sorted(folder.glob(pattern)):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SystemExit(f"{file}: is no image that OpenCV can read")
        found, points = cv2.findChessboardCorners(image, size, flags=flags)
        if not found:
            continue
        grid = np.asarray(points).reshape(size[1], size[0], 2)
        spacing = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
        window = int(np.clip(0.35 * spacing, 2, 11))
        points = np.asarray(points, np.float32).reshape(-1, 1, 2)
        refined = cv2.cornerSubPix(image, points, (window, window), (-1, -1), (3, 100, 1e-4))
        height, width = image.shape
        points2D = np.asarray(refined, float).reshape(-1, 2) + 0.5
        yield BoardView(file.name, width, height, np.arange(len(points2D)), points2D)


def chessboard(size: tuple[int, int], square: float) -> np.ndarray:
    board = np.zeros((size[0] * size[1], 3))
    board[:, :2] = np.mgrid[: size[0], : size[1]].T.reshape(-1, 2) * square
    return board.astype(np.float32).astype(float)


def repeated(views: list[BoardView], count: int) -> list[BoardView]:
    rng = np.random.default_rng(0)
    several = []
    for n in range(count):
        view = views[n % len(views)]
        moved = view.points2D + 0.05 * rng.normal(size=view.points2D.shape)
        several.append(dataclasses.replace(view, name=f"{n}", points2D=moved))
    return several


def rounded(views: list[BoardView]) -> list[BoardView]:
    return [dataclasses.replace(v, points2D=(v.points2D - 0.5).astype(np.float32).astype(float) + 0.5) for v in views]


def sets(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for name, (folder, pattern, size, square) in SETS.items():
        board, views = chessboard(size, square), rounded(list(corners(options.data / folder, pattern, size)))
        sizes = [(v.width, v.height) for v in views]
        views = [v for v, s in zip(views, sizes, strict=True) if s == max(sizes, key=sizes.count)]
        for lens in FLAGS:
            yield beside(name, lens, board, views, options.repeats)
        if name in ("left", "carnd"):
            for lens in FLAGS:
                yield beside(
                    f"{name} repeated", lens, board, rounded(repeated(views, 200)), max(3, options.repeats // 3)
                )
        if name == "left":
            yield from shapes(name, board, views)


def beside(name: str, lens: str, board: np.ndarray, views: list[BoardView], repeats: int) -> dict[str, Any]:
    """One row: ours and OpenCV's on the same corners."""
    config = CalibrationConfig(lens=lens, reject=False, keep_invertible=False)
    ours, our_ms = timed(lambda: calibrate(board, views, config), max(repeats, 9))
    theirs, their_ms = timed(lambda: opencv(lens, board, views, False), repeats)
    row: dict[str, Any] = {"set": name, "lens": lens, "views": len(views), "opencv_ms": their_ms, "ours_ms": our_ms}
    row["times_faster"] = their_ms / our_ms
    if not isinstance(ours, Rejected) and lens != "fisheye":
        row["ours_all_ms"] = our_ms + timed(lambda: covariance(ours, alike=True), repeats)[1]
        theirs, row["opencv_all_ms"] = timed(lambda: opencv(lens, board, views, True), 1)
    if isinstance(ours, Rejected):
        row["ours"] = ours.detail
    else:
        row |= {"rms": ours.rms_px, "converged": ours.converged, "iterations": ours.iterations}
        row["f"] = ours.camera.mean_focal_length
    if isinstance(theirs, str):
        row["opencv"] = theirs
    else:
        row |= {"opencv_rms": theirs[0], "opencv_f": theirs[1]}
    if not isinstance(ours, Rejected) and not isinstance(theirs, str):
        row["rms_excess"] = ours.rms_px - theirs[0]
        if theirs[2] is not None:
            row["sigma_mismatch"] = sigma_mismatch(ours, theirs[2])
            row["sigma_error"] = sigma_mismatch(ours, deviations_by_qr(ours))
    print({k: float(f"{v:.10g}") if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row


def sigma_mismatch(found: Calibration, theirs: np.ndarray) -> float | None:
    covariances = covariance(found, alike=True)
    if isinstance(covariances, Rejected):
        return None
    ours = np.array(list(covariances.deviations.values()))
    return float(np.max(np.abs(ours / theirs[: len(ours)] - 1)))


def deviations_by_qr(found: Calibration) -> np.ndarray:
    """Standard deviations of the camera's free parameters from the Jacobian itself, not from its square."""
    o, estimate, views = found.observations, found.estimate, len(found.observations)
    R, t = estimate.rotations[o.view_of], estimate.translations[o.view_of]
    points = np.einsum("nij,nj->ni", R, o.board[o.rows]) + t
    _, by_point, by_params, _ = found.camera.project_with_jacobians(points)
    J = np.zeros((len(points), 2, 6 * views + len(found.columns)))
    moved = np.concatenate([by_point @ -skew(points), by_point], 2)
    for n, v in enumerate(o.view_of):
        J[n, :, 6 * v : 6 * v + 6] = moved[n]
    J[:, :, 6 * views :] = by_params[:, :, found.columns]
    J = J.reshape(-1, J.shape[2])
    scale = np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(J / scale, mode="r"))
    return (found.sigma_px * np.linalg.norm(inverse, axis=1) / scale)[6 * views :]


def opencv(
    lens: str, board: np.ndarray, views: list[BoardView], deviations: bool
) -> tuple[float, float, np.ndarray | None] | str:
    """(RMS, mean focal length, standard deviations), or what OpenCV complains of."""
    size = (views[0].width, views[0].height)
    try:
        if lens == "fisheye":
            points3D = [board[v.corner_ids].reshape(1, -1, 3) for v in views]
            points2D = [(v.points2D - 0.5).reshape(1, -1, 2) for v in views]
            rms, K, *_ = cv2.fisheye.calibrate(
                points3D, points2D, size, np.eye(3), np.zeros(4), flags=FLAGS[lens], criteria=TIGHT
            )
            return rms, (K[0, 0] + K[1, 1]) / 2, None
        points3D = [board[v.corner_ids].astype(np.float32) for v in views]
        points2D = [(v.points2D - 0.5).astype(np.float32).reshape(-1, 1, 2) for v in views]
        calibrate_camera = cv2.calibrateCameraExtended if deviations else cv2.calibrateCamera
        rms, K, _, _, _, *more = calibrate_camera(
            points3D, points2D, size, np.eye(3), np.zeros(12), flags=FLAGS[lens], criteria=TIGHT
        )
    except cv2.error as error:
        return str(error).splitlines()[0][:120]
    # fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 in both, but for the place of what is held.
    return rms, (K[0, 0] + K[1, 1]) / 2, more[0].ravel() if deviations else None


def timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """The result and the median time of the thread in ms; the first call compiles and does not count."""
    result, seconds = call(), []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        seconds.append(time.thread_time() - start)
    return result, 1e3 * float(np.median(seconds))


def shapes(name: str, board: np.ndarray, views: list[BoardView]) -> Iterator[dict[str, Any]]:
    """What is left when the board need not be flat."""
    for shape in ("flat", "scale", "paraboloid", "height", "free"):
        found = calibrate(board, views, CalibrationConfig(shape=shape, reject=False))
        if isinstance(found, Rejected):
            continue
        row = {"set": name, "shape": shape, "views": len(views), "rms": found.rms_px, "bend": found.shape.bend}
        print(row, flush=True)
        yield row


# --- trials -------------------------------------------------------------------------------------------------------

LENSES = {
    "pinhole": Camera("PINHOLE", 1280, 960, np.array([1050.0, 1043.0, 651.0, 468.0])),
    "opencv4": Camera("OPENCV", 1280, 960, np.array([1050.0, 1043.0, 651.0, 468.0, -0.21, 0.09, 0.0006, -0.0004])),
    "fisheye": Camera("OPENCV_FISHEYE", 1280, 960, np.array([380.0, 378.0, 634.0, 485.0, 0.03, -0.008, 0.004, -0.001])),
    "eucm": Camera("EUCM", 1280, 960, np.array([420.0, 418.0, 634.0, 485.0, 0.62, 1.05])),
}


def trials(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Boards before known cameras, bent by 0.5 mm or flat, other poses and noise in every trial."""
    for lens, camera in LENSES.items():
        for bend in (0.0, 0.0005):
            row = {"lens": lens, "bend_mm": 1e3 * bend, **judged(camera, lens, bend, options.count)}
            print(row, flush=True)
            yield row


def judged(camera: Camera, lens: str, bend: float, count: int) -> dict[str, Any]:
    """Parts of parameters within three sigma; ratios of predicted to true errors; what is found of the bend."""
    board = chessboard((9, 6), 0.03)
    center = board.mean(0)
    across = (board[:, 0] - center[0]) / np.ptp(board[:, 0]) * 2
    bent = board + np.stack([0 * across, 0 * across, bend * (1 - across**2)], 1)
    config = CalibrationConfig(lens=lens, shape="paraboloid" if bend else "flat", reject=False)
    normalised, predicted, errors, bends, failed = [], [], [], [], 0
    for trial in range(count):
        rng = np.random.default_rng(trial)
        views = [held_before(camera, bent, center, rng, f"{n}") for n in range(15)]
        found = calibrate(board, views, config)
        covariances = found if isinstance(found, Rejected) else covariance(found)
        if isinstance(found, Rejected) or isinstance(covariances, Rejected):
            failed += 1
            continue
        sigma = np.array(list(covariances.deviations.values())[: len(camera.params)])
        error = found.camera.params - camera.params
        normalised.append(error / sigma)
        predicted.append(sigma)
        errors.append(error)
        bends.append(found.shape.coefficients[1] if bend else 0.0)
    ratio = np.sqrt(np.mean(np.square(predicted), 0) / np.mean(np.square(errors), 0))
    row: dict[str, Any] = {"trials": count, "failed": failed}
    row["within_3_sigma"] = float(np.mean(np.abs(normalised) < 3))
    row["predicted_over_true"] = [float(f"{r:.3f}") for r in ratio]
    if bend:
        row["bend_found"] = [float(f"{np.quantile(bends, q) / bend:.3f}") for q in (0.005, 0.5, 0.995)]
    return row


def held_before(
    camera: Camera, board: np.ndarray, center: np.ndarray, rng: np.random.Generator, name: str
) -> BoardView:
    """A board somewhere in the image, tilted, as far away as fills a third of it; noise of 0.1 px."""
    wide = camera.model_info.is_fisheye
    middle = np.array([camera.width, camera.height]) * rng.uniform(0.15, 0.85, 2)
    ray = camera.unproject(middle[None])[0][0]
    axis = np.cross([0, 0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    facing = Rotation3.exp(axis / max(sine, 1e-12) * np.arctan2(sine, ray[2]))
    tilt = Rotation3.exp(np.append(rng.uniform(-0.6, 0.6, 2), 0.0))
    turn = facing @ tilt @ Rotation3.exp(np.array([0, 0, rng.uniform(-1, 1)]))
    distance = rng.uniform(0.2, 0.4) if wide else rng.uniform(0.35, 0.7)
    pose = Rigid3(turn, distance * ray - turn @ center)
    pixels, valid = camera.project(pose @ board)
    ids = np.flatnonzero(valid & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1))
    return BoardView(name, camera.width, camera.height, ids, pixels[ids] + 0.1 * rng.normal(size=(len(ids), 2)))


if __name__ == "__main__":
    sys.exit(main())

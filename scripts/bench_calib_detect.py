"""Corners found on the real sets, beside each of OpenCV's detectors, and what they are worth to one calibration.

    python scripts/bench_calib_detect.py DATA/calib [SET…]

For each set: boards and corners of OpenCV's best single detector and of ours; RMS of OpenCV's solver (500+ iterations,
1e-12; Kannala–Brandt for the fisheye set) on the corners of the views that both have: OpenCV's refined by cornerSubPix
in a window of 0.35 × the smallest spacing of each view, and ours; process times.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np

from calib.boards_text import parse_board
from calib.detect import Detection, detect_board
from sfm.io.images import natural_key, read_image

SETS = {
    "left": ("opencv_stereo_lr14/left*.jpg", "chessboard:9x6:25mm"),
    "right": ("opencv_stereo_lr14/right*.jpg", "chessboard:9x6:25mm"),
    "bouguet": ("bouguet_example/*.tif", "chessboard:13x12:30mm"),
    "carnd": ("carnd_camera_cal/*.jpg", "chessboard:9x6:25mm"),
    "sony": ("boofcv_mono_Sony_DSC-HX5V_Chess/*.jpg", "chessboard:4x6:30mm"),
    "bumblebee L": ("boofcv_stereo_Bumblebee2_Chess/left*.jpg", "chessboard:4x6:30mm"),
    "bumblebee R": ("boofcv_stereo_Bumblebee2_Chess/right*.jpg", "chessboard:4x6:30mm"),
    "fisheye": ("boofcv_fisheye_chessboard/*.jpg", "chessboard:4x6:30mm"),
    "extra": ("opencv_extra_cameracalibration/*.png", "chessboard:5x7:30mm"),
    "circles": ("boofcv_mono_Sony_DSC-HX5V_CircleRegular/*.jpg", "circles:8x10:25mm:15mm"),
    "aprilgrid": ("aprilgrid_rs_samples/*.png", "aprilgrid:6x6:88mm:26.4mm"),
}
TIGHT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-12)


def opencv_detectors(board):
    """Functions of a grey photo that give corners in OpenCV's pixels, or None."""
    if board.kind == "aprilgrid":
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = 2
        tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        finder = cv2.aruco.ArucoDetector(tags, parameters)
        return {"tags": lambda grey: np.concatenate([c.reshape(4, 2) for c in finder.detectMarkers(grey)[0]])}
    if board.has_circles:
        flags = {"circles": 0, "circles, clustering": cv2.CALIB_CB_CLUSTERING}
        return {n: lambda g, f=f: found(cv2.findCirclesGrid(g, board.grid, flags=f | 1)) for n, f in flags.items()}
    patient = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    plain = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    flags = {"SB": 0, "SB patient": patient, "SB normalised": patient | cv2.CALIB_CB_NORMALIZE_IMAGE}
    return {"quads": lambda g: found(cv2.findChessboardCorners(g, board.grid, flags=plain))} | {
        n: lambda g, f=f: found(cv2.findChessboardCornersSB(g, board.grid, flags=f)) for n, f in flags.items()
    }


def found(answer):
    return np.asarray(answer[1], np.float64).reshape(-1, 2) if answer[0] else None


def refined(grey, corners):
    between = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(between, np.inf)
    half = max(2, int(0.35 * between.min()))
    points = corners.astype(np.float32).reshape(-1, 1, 2).copy()
    cv2.cornerSubPix(grey, points, (half, half), (-1, -1), (3, 200, 1e-4))
    return points.reshape(-1, 2)


def rms(objects, images, size, fisheye):
    if fisheye:
        objects = [points.reshape(1, -1, 3).astype(np.float64) for points in objects]
        images = [points.reshape(1, -1, 2).astype(np.float64) for points in images]
        extrinsic = getattr(cv2.fisheye, "CALIB_RECOMPUTE_EXTRINSIC", None) or cv2.CALIB_RECOMPUTE_EXTRINSIC
        skew = getattr(cv2.fisheye, "CALIB_FIX_SKEW", None) or cv2.CALIB_FIX_SKEW
        flags = extrinsic | skew | cv2.CALIB_USE_INTRINSIC_GUESS
        start = np.array([[230.0, 0, size[0] / 2], [0, 230.0, size[1] / 2], [0, 0, 1]])
        return cv2.fisheye.calibrate(objects, images, size, start, np.zeros(4), flags=flags, criteria=TIGHT)[0]
    objects = [points.astype(np.float32) for points in objects]
    images = [points.astype(np.float32) for points in images]
    return cv2.calibrateCamera(objects, images, size, None, None, criteria=TIGHT)[0]


def compare(name, folder):
    pattern, word = SETS[name]
    board = parse_board(word)
    photos = [read_image(p, gray=True) for p in sorted(folder.glob(pattern), key=lambda p: natural_key(p.name))]
    theirs, times = {}, {}
    for detector, find in opencv_detectors(board).items():
        start = time.process_time()
        theirs[detector] = [find(photo) for photo in photos]
        times[detector] = time.process_time() - start
    best = max(theirs, key=lambda detector: sum(0 if c is None else len(c) for c in theirs[detector]))
    detect_board(photos[0], board)  # kernels
    start = time.process_time()
    found = [detect_board(photo, board) for photo in photos]
    ours_time = time.process_time() - start
    ours = {k: d for k, d in enumerate(found) if isinstance(d, Detection)}
    told = [
        f"{sum(c is not None for c in theirs[best])}/{len(photos)}",
        f"{sum(0 if c is None else len(c) for c in theirs[best])}",
        f"{len(ours)}/{len(photos)}",
        f"{sum(len(d.points2D) for d in ours.values())}",
    ]
    sizes = [photo.shape for photo in photos]
    common = [k for k in ours if theirs[best][k] is not None and sizes[k] == sizes[0]]
    errors = ["–", "–"]
    if board.kind != "aprilgrid" and len(common) > 3:
        size, fisheye = sizes[0][::-1], name == "fisheye"
        points = [theirs[best][k] if board.has_circles else refined(photos[k], theirs[best][k]) for k in common]
        for which, objects, images in (
            (0, [board.points3D] * len(common), points),
            (1, [board.points3D[ours[k].corner_ids] for k in common], [ours[k].points2D for k in common]),
        ):
            try:
                errors[which] = f"{rms(objects, images, size, fisheye):.4f}"
            except cv2.error:
                errors[which] = "fails"
    ratio = f"{ours_time / times[best]:.1f}"
    print("| " + " | ".join([name, best, *told, *errors, ratio]) + " |", flush=True)


def main():
    cv2.setNumThreads(1)
    folder = Path(sys.argv[1])
    print(
        "| set | OpenCV's best | boards | corners | ours: boards | corners | RMS OpenCV | RMS ours | time ours / its |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in sys.argv[2:] or SETS:
        compare(name, folder)


if __name__ == "__main__":
    main()

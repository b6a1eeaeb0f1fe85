"""Calibration from rendered photos of boards beside the truth: every trial draws poses, blur and noise of its own.

    python -m scripts.bench_calib_rendered [--count 200] [--first 0] [--cases pinhole opencv4 …] [--json FILE]

Photos are 640 x 480; boards are rendered by rays through a grid of 3 x 3 in each pixel, blurred by 0.5 to 1.1 px and
given noise of 1 to 2 % of full scale, then 8 bits. A ChArUco board may be cut by the image; a bent one is higher in its
middle column by 0.5 mm, along an arc over its length. What is reported: corners found, their error; how many parameters
are within three of their standard deviations of the truth; predicted over true deviations, by corners and by views; the
bend that was found over the true one.

The ratio of predicted deviations to errors of N trials is known to 1/√(2 N) only. Errors of parameters are sums over
the views, though, each of which is drawn on its own,

    dθ = Σ_v c_v,      c_v = Σ (Σ_i D_iᵀ e_i)

with the true errors e_i of a view's corners and their derivatives D_i as in `calib.uncertainty_corners`; so E dθ² is
E Σ_v c_v² as well, known four times as well with 15 views. Corners of a view may be correlated as they like: nothing
but that views are independent is assumed. `linear` is the correlation of the sums with the errors that were found.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.boards import Board, charuco, chessboard
from calib.boards_artwork import artwork
from calib.detect import Detection, detect_board
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from calib.uncertainty import covariance
from calib.uncertainty_corners import corner_derivatives
from datasets.synthetic.boards import PARTS, SURROUND, texture
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

VIEWS, TEXELS_PER_M, MARGIN_PX = 15, 4000.0, 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A camera and a board; how far from the middle boards are held (by the image's size), and at what distance."""

    camera: Camera
    lens: str
    board: Board
    bend: float
    reach: float
    distance: tuple[float, float]


_BOARD, _MARKED = chessboard(9, 6, 0.03), charuco(10, 7, 0.03, 0.022)
CASES = {
    "pinhole": Case(
        camera=Camera("PINHOLE", 640, 480, np.array([560.0, 556.0, 326.0, 234.0])), lens="pinhole", board=_BOARD,
        bend=0.0, reach=0.18, distance=(0.42, 0.6),
    ),
    "opencv4": Case(
        camera=Camera("OPENCV", 640, 480, np.array([560.0, 556.0, 326.0, 234.0, -0.21, 0.09, 0.0006, -0.0004])),
        lens="opencv4", board=_MARKED, bend=0.0005, reach=0.35, distance=(0.35, 0.6),
    ),
    "fisheye": Case(
        camera=Camera("OPENCV_FISHEYE", 640, 480, np.array([260.0, 259.0, 318.0, 242.0, 0.03, -0.008, 0.004, -0.001])),
        lens="fisheye", board=_MARKED, bend=0.0, reach=0.38, distance=(0.2, 0.3),
    ),
    "fisheye190": Case(
        camera=Camera("OPENCV_FISHEYE", 640, 480, np.array([192.0, 191.0, 318.0, 242.0, 0.01, -0.003, 0.001, 0.0])),
        lens="fisheye", board=_MARKED, bend=0.0005, reach=0.42, distance=(0.14, 0.22),
    ),
    "fisheye120": Case(
        camera=Camera("OPENCV_FISHEYE", 720, 400, np.array([330.0, 332.0, 352.0, 207.0, -0.02, 0.01, -0.004, 0.0])),
        lens="fisheye", board=chessboard(8, 5, 0.025), bend=0.0, reach=0.25, distance=(0.17, 0.3),
    ),
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first trial; each draws by its number")
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.cases:
        with ProcessPoolExecutor(options.processes) as pool:
            made = list(pool.map(partial(trial, name), range(options.first, options.first + options.count)))
        rows.append({"case": name, **judged(CASES[name], made)})
        print(json.dumps(rows[-1]), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return 0


def trial(name: str, number: int) -> dict[str, Any]:
    """One calibration: errors of the parameters and their predicted deviations, the bend, what was seen."""
    cv2.setNumThreads(1)
    return calibrated(CASES[name], *photographed(name, number))


def calibrated(case: Case, views: list[BoardView], errors: list[np.ndarray], wanted: int) -> dict[str, Any]:
    """What comes of a trial's views."""
    found = calibrate(
        case.board.points3D, views, CalibrationConfig(lens=case.lens, shape="paraboloid" if case.bend else "flat")
    )
    out: dict[str, Any] = {"wanted": wanted, "seen": sum(map(len, errors)), "views": len(views)}
    out["corner_px"] = float(np.sqrt(np.mean(np.square(np.concatenate(errors))))) if errors else None
    if isinstance(found, Rejected):
        return {**out, "failed": f"{found.reason} {found.detail}"}
    count = len(case.camera.params)
    given = covariance(found), covariance(found, by_view=True)
    sigmas = [None if isinstance(one, Rejected) else list(one.deviations.values())[:count] for one in given]
    return {
        **out, "error": (found.camera.params - case.camera.params).tolist(), "sigma": sigmas[0] or None,
        "sigma_by_view": sigmas[1] or None, "parts": parts_of_views(found, views, errors)[:, :count].tolist(),
        "bend": float(found.shape.coefficients[1]) if case.bend else None,
        "rms": found.rms_px, "rejected": len(found.rejected_corners),
    }  # fmt: skip


def parts_of_views(found: Calibration, views: list[BoardView], errors: list[np.ndarray]) -> np.ndarray:
    """(V, K) of the error of what views share: what the errors (n, 2) of each view's corners have made of it."""
    seen, shape, true_errors = found.observations, found.shape, {}
    for view, off in zip(views, errors, strict=True):
        true_errors[view.name] = dict(zip(view.corner_ids.tolist(), off, strict=True))
    S, scores = 0.0, []
    for v, name in enumerate(seen.names):
        part = slice(seen.offsets[v], seen.offsets[v + 1])
        rows = seen.rows[part]
        by = corner_derivatives(
            found.camera, found.columns, found.cams_from_board[v], seen.board[rows] + shape.displacements[rows],
            shape.basis[rows], seen.roots[part], np.stack([true_errors[name][int(row)] for row in rows]),
        )  # fmt: skip
        J = np.concatenate([by.by_params, by.by_shape], 2).reshape(2 * len(rows), -1)
        P = by.by_pose.reshape(2 * len(rows), 6)
        D = J - P @ np.linalg.lstsq(P, J, rcond=None)[0]
        S = S + D.T @ D
        scores.append(D.T @ by.residuals.ravel())
    return np.linalg.solve(S, np.array(scores).T).T


def photographed(name: str, number: int) -> tuple[list[BoardView], list[np.ndarray], int]:
    """What the detector finds in a trial's photos: views, the errors (n, 2) of their corners, how many there were."""
    case, rng = CASES[name], np.random.default_rng([len(name), number])
    views, errors, wanted = [], [], 0
    rays = rays_of(name)
    for k in range(VIEWS):
        photo, truth = held_before(case, rays, rng)
        wanted += int(np.sum(np.all((truth > 3) & (truth < [case.camera.width - 3, case.camera.height - 3]), axis=1)))
        seen = detect_board(photo, case.board, name=f"{k}")
        if isinstance(seen, Detection):
            views.append(BoardView(f"{k}", seen.width, seen.height, seen.corner_ids, seen.points2D))
            errors.append(seen.points2D - truth[seen.corner_ids])
    return views, errors, wanted


def judged(case: Case, made: list[dict[str, Any]]) -> dict[str, Any]:
    """The table's row."""
    good = [one for one in made if one.get("sigma") and one.get("sigma_by_view")]
    row: dict[str, Any] = {"trials": len(made), "failed": [one.get("failed", "") for one in made if one not in good]}
    if not good:
        return row
    row["corners_found"] = sum(one["seen"] for one in made) / sum(one["wanted"] for one in made)
    row["corner_px"] = float(np.median([one["corner_px"] for one in made if one["corner_px"]]))
    row["rms"] = float(np.median([one["rms"] for one in good]))
    row["rejected"] = float(np.mean([one["rejected"] for one in good]))
    errors = np.array([one["error"] for one in good])
    for key in ("sigma", "sigma_by_view"):
        sigma = np.array([one[key] for one in good])
        row[f"within_3_{key}"] = float(np.mean(np.abs(errors / sigma) < 3))
        ratio = np.sqrt(np.mean(sigma**2, 0) / np.mean(errors**2, 0))
        row[f"{key}_over_true"] = rounded(ratio)
    parts = [np.array(one["parts"]) for one in good]
    squares = np.array([np.sum(part**2, 0) for part in parts]) / np.array([one["sigma"] for one in good]) ** 2
    row["sigma_over_parts"] = rounded(1 / np.sqrt(squares.mean(0)))
    row["known_to"] = rounded(0.5 * squares.std(0) / squares.mean(0) / np.sqrt(len(good)))
    sums = np.array([part.sum(0) for part in parts])
    row["linear"] = float(min(np.corrcoef(sums[:, k], errors[:, k])[0, 1] for k in range(errors.shape[1])))
    row["bias_over_true"] = rounded(np.mean(errors, 0) / np.sqrt(np.mean(errors**2, 0)))
    if case.bend:
        bends = np.array([one["bend"] for one in good]) / case.bend
        row["bend_found"] = rounded(np.quantile(bends, [0.005, 0.05, 0.5, 0.95, 0.995]))
    return row


def rounded(numbers: np.ndarray) -> list[float]:
    """For the table."""
    return [float(f"{number:.3f}") for number in numbers]


# --- photos -------------------------------------------------------------------------------------------------------


class Rays:
    """Of the fine grid of a camera, computed once."""

    def __init__(self, camera: Camera) -> None:
        y, x = (np.mgrid[: camera.height * PARTS, : camera.width * PARTS] + 0.5) / PARTS
        rays, self.seen = camera.unproject(np.column_stack([x.ravel(), y.ravel()]))
        self.rays, self.seen = rays.reshape(*x.shape, 3), self.seen.reshape(x.shape)


@cache
def rays_of(name: str) -> Rays:
    """Once in a process."""
    return Rays(CASES[name].camera)


def held_before(case: Case, rays: Rays, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A photo, and the pixels (P, 2) of the board's points, NaN for those without."""
    camera, board = case.camera, case.board
    size = np.array([camera.width, camera.height])
    points3D = bent(case, board.points3D)
    while True:
        pose = drawn_pose(case, rng)
        points2D, valid = camera.project(pose @ points3D)
        inside = valid & np.all((points2D > 0) & (points2D < size), axis=1)
        # A plain chessboard has to be in the image with a margin, and seen from the front; of the other a part does.
        enough = inside.all() if not board.has_markers else inside.sum() >= 0.4 * len(inside)
        if enough and np.all((pose @ points3D)[:, 2] > 0.02 if not camera.model_info.is_fisheye else True):
            break
    image = rendered(case, rays, pose, points2D[inside], rng.uniform(0.5, 1.1), rng)
    return image, np.where(valid[:, None], points2D, np.nan)


def drawn_pose(case: Case, rng: np.random.Generator) -> Rigid3:
    """A board whose middle is somewhere in the image, tilted by up to 40 degrees, turned by up to 60."""
    camera = case.camera
    middle = np.array([camera.width, camera.height]) * rng.uniform(0.5 - case.reach, 0.5 + case.reach, 2)
    rays, valid = camera.unproject(middle[None])
    if not valid[0]:
        return drawn_pose(case, rng)
    ray = rays[0]
    axis = np.cross([0, 0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    facing = Rotation3.exp(axis / max(sine, 1e-12) * np.arctan2(sine, ray[2]))
    turn = facing @ Rotation3.exp(np.append(rng.uniform(-0.7, 0.7, 2), 0.0))
    turn = turn @ Rotation3.exp(np.array([0, 0, rng.uniform(-1, 1)]))
    return Rigid3(turn, rng.uniform(*case.distance) * ray - turn @ case.board.points3D.mean(0))


def bent(case: Case, points3D: np.ndarray) -> np.ndarray:
    """Points of the bent board, by their places on the flat one."""
    return np.column_stack([points3D[:, :2], height(case, points3D[:, 0])])


def height(case: Case, x: np.ndarray) -> np.ndarray:
    """Of the bent board, metres."""
    ends = case.board.points3D[:, 0]
    across = (2 * x - ends.min() - ends.max()) / np.ptp(ends)
    return case.bend * (1 - across**2)


def rendered(
    case: Case, rays: Rays, pose: Rigid3, near: np.ndarray, blur_px: float, rng: np.random.Generator
) -> np.ndarray:
    """The photo as uint8. Rays are followed only where the board may be."""
    camera, drawn, paint = case.camera, artwork(case.board), _paint(case)
    span = max(60.0, float(np.ptp(near, axis=0).max()))  # what is printed beyond the corners
    low = np.clip(near.min(0) - 0.45 * span - MARGIN_PX, 0, None).astype(int)
    high = np.clip(near.max(0) + 0.45 * span + MARGIN_PX, 0, [camera.width, camera.height]).astype(int)
    part = np.s_[low[1] * PARTS : high[1] * PARTS, low[0] * PARTS : high[0] * PARTS]
    directions, inverse = rays.rays[part] @ pose.rotation.matrix, pose.inverse()
    center = inverse.translation
    depth = -center[2] / directions[..., 2]
    for _ in range(2 if case.bend else 0):
        across = center[0] + depth * directions[..., 0]
        depth = (height(case, across) - center[2]) / directions[..., 2]
    hits = center[:2] + depth[..., None] * directions[..., :2]
    place = (hits + drawn.corners[0]) * TEXELS_PER_M - 0.5
    place[~(rays.seen[part] & (depth > 0) & np.isfinite(depth))] = -1e6
    columns, rows = cv2.split(np.clip(place, -1e6, 1e6).astype(np.float32))
    fine = cv2.remap(
        paint, columns, rows, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=SURROUND,
    )  # fmt: skip
    fine = cv2.GaussianBlur(fine, (0, 0), blur_px * PARTS)
    image = np.full((camera.height, camera.width), SURROUND)
    rows, columns = high[1] - low[1], high[0] - low[0]
    image[low[1] : high[1], low[0] : high[0]] = fine.reshape(rows, PARTS, columns, PARTS).mean(axis=(1, 3))
    image += rng.normal(0, rng.uniform(0.01, 0.02), image.shape)
    return np.clip(np.rint(255 * image), 0, 255).astype(np.uint8)


_PAINTS: dict[str, np.ndarray] = {}


def _paint(case: Case) -> np.ndarray:
    if case.board.spec not in _PAINTS:
        _PAINTS[case.board.spec] = texture(case.board, TEXELS_PER_M)
    return _PAINTS[case.board.spec]


if __name__ == "__main__":
    sys.exit(main())

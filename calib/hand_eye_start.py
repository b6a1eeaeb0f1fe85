"""Where a camera sits on a robot, in closed form, and whether the robot's motions tell it.

With G_k = mount_from_world of the robot (the camera is on the mount; the board is fixed in the world) and C_k =
cam_from_board of the camera, both unknowns are in

    C_k = X G_k Z        X = cam_from_mount,  Z = world_from_board

Between two poses Z cancels:  B X = X A  with A = G_j G_i⁻¹ and B = C_j C_i⁻¹, the same motion seen by robot and camera.
So the angles of A and B agree, and their axes are turned by the rotation of X. With α, β the rotation vectors of A, B:

    R_X minimises Σ |β − R α|                     (Wahba's problem, by SVD with weights)
    t_X solves    (I − R_B) t_X = t_B − R_X t_A   (the same; pairs of large angle count more by themselves)

and then Z is the mean of G_k⁻¹ X⁻¹ C_k. Two motions about axes that are not parallel are needed: of a camera on a robot
that turns about one axis only, the place along that axis is open.

Reference:
    Park & Martin, Robot sensor calibration: solving AX = XB on the Euclidean group, IEEE T-RA 1994.
    Tsai & Lenz, A new technique for fully autonomous and efficient 3D robotics hand/eye calibration, IEEE T-RA 1989.
"""

from __future__ import annotations

import math

import numpy as np

from calib.board_turns import BoardTurn
from sfm.core.arrays import FloatArray, Vector
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

_LEAST_TURN = math.radians(2.0)
"""Spread of the mount's orientations about the second of its axes, below which they are as good as one axis."""
_AGREE = math.radians(5.0)
"""Angle between a pose and what is predicted, beyond which robot and camera do not describe the same motion."""
_UNITS = {
    1e-3: "millimetres were", 1e-2: "centimetres were", 0.0254: "inches were", 0.3048: "feet were",
    1e3: "a thousandth was", 1e2: "a hundredth was",
}  # fmt: skip
"""What was taken for metres, by the factor that mends it."""
_LIKE = 1.1
"""Ratio of a factor to that of a unit within which it is this unit."""
_SCALE = 1.5
"""Factor of the robot's translations, beyond which they are in another unit than the board."""
_NEAR = 0.02
"""Distance of boards from where they are predicted, over that from the camera: below it units are right."""
_PAIRS = 4000
_PASSES = 8
"""Beyond the first, pairs have the weights of least absolute errors: poses of other photos must not lead astray."""
_FLOOR = 1e-3
"""Least error that such a weight is taken from: radians, or part of the usual movement."""


def turned_enough(mounts: Rotation3) -> Rejected | None:
    """Whether orientations of the mount are spread about two axes; otherwise why not, in degrees."""
    spread = axis_spread(mounts)
    if spread[0] < _LEAST_TURN:
        return Rejected(
            "no_rotation",
            f"the robot's orientations differ by {math.degrees(spread[0]):.1f}° only; turn it by 20° and more about "
            "two axes",
        )
    if spread[1] < _LEAST_TURN:
        return Rejected(
            "one_axis",
            f"the robot turns about one axis only, by {math.degrees(spread[0]):.0f}°, and about others by "
            f"{math.degrees(spread[1]):.1f}°; the place of the camera along that axis is open: turn about a second one",
        )
    return None


def axis_spread(rotations: Rotation3) -> Vector:
    """(3,) roots of the mean squares of the angles from the mean orientation about its principal axes, descending."""
    _, vectors = np.linalg.eigh(rotations.wxyz.T @ rotations.wxyz)
    mean = Rotation3(np.tile(vectors[:, -1], (len(rotations.wxyz), 1)))
    turns = (rotations @ mean.inverse()).log()
    return np.linalg.svd(turns, compute_uv=False) / math.sqrt(len(turns))


def pairs_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """All pairs i < j, or of many poses those whose distance is a power of two, and their neighbours."""
    i, j = np.triu_indices(count, 1)
    if len(i) <= _PAIRS:
        return i, j
    kept = np.linspace(0, len(i) - 1, _PAIRS).astype(int)
    return i[kept], j[kept]


def closed_form(mounts_from_world: Rigid3, cams_from_board: Rigid3) -> tuple[Rigid3, Rigid3]:
    """(cam_from_mount, world_from_board) of batches (V,) of poses."""
    i, j = pairs_of(len(mounts_from_world))
    A = mounts_from_world[j] @ mounts_from_world[i].inverse()
    B = cams_from_board[j] @ cams_from_board[i].inverse()
    alpha, beta = A.rotation.log(), B.rotation.log()
    # A rotation vector of nearly π has no sign to be trusted.
    usable = np.where(np.maximum(A.rotation.angle, B.rotation.angle) < 0.95 * np.pi, 1.0, 0.0)
    weights, rotation = usable, Rotation3.identity()
    for _ in range(_PASSES):
        rotation = _wahba(alpha, beta, weights)
        weights = usable / np.maximum(np.linalg.norm(beta - rotation @ alpha, axis=1), _FLOOR)
    left = np.eye(3) - B.rotation.matrix
    right = B.translation - A.translation @ rotation.matrix.T
    weights, t = np.ones(len(right)), np.zeros(3)
    for _ in range(_PASSES):
        root = np.sqrt(weights)[:, None]
        t = np.linalg.lstsq((root[:, :, None] * left).reshape(-1, 3), (root * right).reshape(-1), rcond=None)[0]
        off = np.linalg.norm(left @ t - right, axis=1)
        weights = 1 / np.maximum(off, _FLOOR * max(float(np.median(np.linalg.norm(right, axis=1))), 1e-9))
    cam_from_mount = Rigid3(rotation, t)
    many = Rigid3.stack([cam_from_mount] * len(mounts_from_world))
    return cam_from_mount, mean_motion((many @ mounts_from_world).inverse() @ cams_from_board)


def _wahba(a: FloatArray, b: FloatArray, weights: Vector) -> Rotation3:
    """R with b ≈ R a."""
    U, _, Vt = np.linalg.svd((weights[:, None] * b).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return Rotation3.from_matrix((U * sign) @ Vt)


def mean_motion(motions: Rigid3) -> Rigid3:
    """Mean of the rotations that minimises about the sum of angles, median of the translations."""
    q, weights = motions.rotation.wxyz, np.ones(len(motions))
    mean = q[0]
    for _ in range(_PASSES):
        _, vectors = np.linalg.eigh((weights[:, None] * q).T @ q)
        mean = vectors[:, -1]
        weights = 1 / np.maximum(np.sqrt(np.maximum(1 - (q @ mean) ** 2, 0.0)), _FLOOR)
    return Rigid3(Rotation3(mean), np.median(motions.translation, axis=0))


def consistent_turns(
    mounts_from_world: Rigid3, cams_from_board: Rigid3, turns: tuple[BoardTurn, ...]
) -> np.ndarray:  # fmt: skip
    """(V,) by which of the board's turns each view must be read, so that robot and camera turn by the same angles.

    The view that most others agree with is read as it was.
    """
    count = len(mounts_from_world)
    if len(turns) == 1:
        return np.zeros(count, np.int64)
    angles = _between(mounts_from_world.rotation)
    read = [(cams_from_board @ Rigid3.stack([turn.motion.inverse()] * count)).rotation for turn in turns]
    off = np.stack([np.abs(_between(cams_from_board.rotation, one) - angles) for one in read])
    best = int(np.argmin(off.min(0).sum(1)))
    return off[:, best].argmin(0).astype(np.int64)


def _between(rotations: Rotation3, others: Rotation3 | None = None) -> FloatArray:
    """(V, V) angles of rotation i of the first to rotation j of the second."""
    dots = np.abs(rotations.wxyz @ (rotations if others is None else others).wxyz.T)
    return 2 * np.arccos(np.clip(dots, 0.0, 1.0))


def motions_agree(mounts_from_world: Rigid3, cams_from_board: Rigid3, *, hand_is_mount: bool) -> Rejected | None:
    """Whether robot and camera describe the same motions; otherwise what may be the reason.

    Quaternions whose real part is last, taken for first, are those of the inverse rotations but for a turn of both
    frames: angles do not tell them, axes do, and translations tell which of the two it is.
    """
    off, _ = _misfit(mounts_from_world, cams_from_board)
    if off <= _AGREE:
        return None
    told = f"motions of robot and camera differ by {math.degrees(off):.0f}°"
    table = mounts_from_world.inverse() if hand_is_mount else mounts_from_world
    swapped = Rigid3(Rotation3(np.roll(table.rotation.wxyz, 1, axis=1)), table.translation)
    others = {
        "quaternion_order": (swapped, "with quaternions as x, y, z, w they agree"),
        "inverse_poses": (table.inverse(), "the inverse poses agree: the table holds hand_from_base, or the camera is "
                          "not on the side that was named"),
    }  # fmt: skip
    fits = {}
    for reason, (poses, _) in others.items():
        angle, distance = _misfit(poses.inverse() if hand_is_mount else poses, cams_from_board)
        if angle <= _AGREE:
            fits[reason] = distance
    if not fits:
        return Rejected("motions_disagree", f"{told}; do photos and poses belong together, and are rotations right?")
    reason = min(fits, key=lambda one: fits[one])
    return Rejected(reason, f"{told}; {others[reason][1]}")


def _misfit(mounts_from_world: Rigid3, cams_from_board: Rigid3) -> tuple[float, float]:
    """Angle and distance of the board's poses from those that the closed form predicts; a quarter is farther off."""
    X, Z = closed_form(mounts_from_world, cams_from_board)
    count = len(mounts_from_world)
    predicted = Rigid3.stack([X] * count) @ mounts_from_world @ Rigid3.stack([Z] * count)
    apart = cams_from_board.translation - predicted.translation
    angles = (predicted.rotation @ cams_from_board.rotation.inverse()).angle
    return float(np.quantile(angles, 0.75)), float(np.quantile(np.linalg.norm(apart, axis=1), 0.75))


def same_unit(mounts_from_world: Rigid3, cams_from_board: Rigid3, cam_from_mount: Rigid3) -> Rejected | None:
    """Whether translations of the robot are in the board's unit; they fit best times a factor s near 1:

    (I − R_B) t_X + s R_X t_A = t_B.
    """
    _, off = _misfit(mounts_from_world, cams_from_board)
    if off < _NEAR * float(np.median(np.linalg.norm(cams_from_board.translation, axis=1))):
        return None
    i, j = pairs_of(len(mounts_from_world))
    A = mounts_from_world[j] @ mounts_from_world[i].inverse()
    B = cams_from_board[j] @ cams_from_board[i].inverse()
    moved = (A.translation @ cam_from_mount.rotation.matrix.T)[:, :, None]
    left = np.concatenate([np.eye(3) - B.rotation.matrix, moved], axis=2).reshape(-1, 4)
    scale = np.max(np.abs(left), axis=0)
    if not np.all(scale > 0):
        return None
    solution, _, rank, _ = np.linalg.lstsq(left / scale, B.translation.reshape(-1), rcond=1e-6)
    factor = float(solution[3] / scale[3])
    if rank < 4 or 1 / _SCALE < factor < _SCALE:
        return None
    told = f"the robot's translations fit best if they are multiplied by {factor:.3g}"
    for unit, name in _UNITS.items():
        if 1 / _LIKE < factor / unit < _LIKE:
            return Rejected("other_unit", f"{told}: {name} taken for metres")
    return Rejected("motions_disagree", f"{told}; do photos and poses belong together, and are positions right?")

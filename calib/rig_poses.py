"""How cameras of a rig stand to one another, from poses of the board that each of them found for itself.

Two cameras that see the board in one frame give their relative pose,

    cam2_from_cam1 = cam2_from_board · board_from_cam1

once for each frame. A board that looks the same after a turn, as a chessboard with an even number of rows and columns
does after half a one, may be read by one camera from one end and by the other from the other end. Then the relative
pose is

    cam2_from_board · g · board_from_cam1

with g one of the board's turns. Wrong readings give relative poses that differ from frame to frame, as the axis of g
moves with the board; so the one is believed that most frames can agree to, each with its best g.

Relative poses are compared by the angle at which camera 2 sees apart where they put the board's outermost points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from calib.board_turns import BoardTurn
from sfm.core.arrays import FloatArray, Points3D, Value, Vector
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.graphs.spanning_tree import maximum_spanning_tree
from sfm.core.graphs.union_find import connected_components

_CAP = 0.1
"""Radians beyond which a frame disagrees, by however much."""
_CANDIDATES = 60
_AGREEING = 3.0
"""Times the median angle of the frames that agree within which one counts for the average."""
_AVERAGING = 4
_TOLD_APART = 2.0
"""A turn of the board is told from another if its frames agree by this factor better."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RelativePose(Value):
    """Of two cameras.

    Attributes:
        turns: (F,) by which of the board's turns camera 2 must read each frame to agree with camera 1.
        angles: (F,) at which the frame's own relative pose is apart from this one, radians.
        doubtful: whether another choice of turns agrees about as well.
    """

    cam2_from_cam1: Rigid3
    turns: Int64[np.ndarray, " F"]
    angles: Float64[np.ndarray, " F"]
    doubtful: bool


def relative_pose(
    cam1_from_board: Rigid3, cam2_from_board: Rigid3, turns: Sequence[BoardTurn], probes: Points3D
) -> RelativePose:
    """The pose on which most frames agree, averaged over those.

    Args:
        cam1_from_board, cam2_from_board: batches (F,) of the same frames.
        turns: of the board, the first is none.
        probes: (M, 3) points of the board by which poses are compared.
    """
    frames = len(cam1_from_board)
    pose1, pose2, points = _square(cam1_from_board), _square(cam2_from_board), _homogeneous(probes)
    read = pose2 @ _untwisted(turns)[:, None]
    tried, seen1, seen2 = read @ np.linalg.inv(pose1), pose1 @ points, read @ points
    depth = np.linalg.norm(seen2[:, :, :3], axis=2).mean(2)
    some = np.unique(np.linspace(0, frames - 1, min(frames, max(_CANDIDATES // len(turns), 8))).astype(int))
    candidates = tried[:, some].reshape(-1, 4, 4)
    apart = _angles(candidates, seen1, seen2, depth)
    choices, scores = apart.argmin(1), np.minimum(apart.min(1), _CAP).sum(1)
    alike = np.flatnonzero(scores <= _TOLD_APART * scores.min() + 1e-9 * frames)
    doubtful = len(np.unique(choices[alike], axis=0)) > 1
    if doubtful:  # trace R = 1 + 2 cos: the smallest turn between the cameras
        best = alike[np.argmax(np.trace(candidates[alike, :3, :3], axis1=1, axis2=2))]
    else:
        best = int(np.argmin(scores))
    motion = candidates[best]
    for _ in range(_AVERAGING):
        apart = _angles(motion[None], seen1, seen2, depth)[0]
        motion = _average(motion, tried[apart.argmin(0), np.arange(frames)], apart.min(0))
    apart = _angles(motion[None], seen1, seen2, depth)[0]
    return RelativePose(Rigid3.from_matrix(motion), apart.argmin(0), apart.min(0), doubtful)


def _angles(motions: FloatArray, seen1: FloatArray, seen2: FloatArray, depth: FloatArray) -> FloatArray:
    """(C, G, F) at which camera 2 sees apart what it saw and what camera 1 saw, moved there."""
    off = motions[:, None, None] @ seen1 - seen2
    return np.sqrt(np.mean(np.sum(off * off, axis=3), axis=3)) / depth


def _average(motion: FloatArray, own: FloatArray, apart: Vector) -> FloatArray:
    """One step to the least sum of distances from the motions (F, 4, 4) that agree."""
    typical = float(np.median(apart[apart < _CAP])) if np.any(apart < _CAP) else _CAP
    weights = np.where(apart <= _AGREEING * typical + 1e-12, 1 / np.maximum(apart, 1e-9), 0.0)
    weights /= weights.sum()
    steps = Rotation3.from_matrix(own[:, :3, :3] @ motion[:3, :3].T).log()
    moved = np.eye(4)
    moved[:3, :3] = Rotation3.exp(weights @ steps).matrix @ motion[:3, :3]
    moved[:3, 3] = weights @ own[:, :3, 3]
    return moved


def _square(poses: Rigid3) -> FloatArray:
    """Matrices (F, 4, 4)."""
    out = np.zeros((*poses.shape, 4, 4))
    out[..., :3, :], out[..., 3, 3] = poses.matrix, 1.0
    return out


def _homogeneous(points: Points3D) -> FloatArray:
    """Columns (4, M)."""
    return np.concatenate([points, np.ones((len(points), 1))], axis=1).T


def _untwisted(turns: Sequence[BoardTurn]) -> FloatArray:
    """(G, 4, 4): a pose times one of them is that of the board read after the turn."""
    return np.linalg.inv(np.stack([_square(turn.motion) for turn in turns]))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraFrames(Value):
    """Of one camera by itself the poses `cams_from_board` (V,) in some of F frames, and its corners in all (F,)."""

    frames: Int64[np.ndarray, " V"]
    cams_from_board: Rigid3
    corners: Int64[np.ndarray, " F"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Connection(Value):
    """Two cameras, 1 before 2, and what connects them: frames that show the board to both, and corners in these."""

    camera1: int
    camera2: int
    frames: Int64[np.ndarray, " F"]
    corners: int


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FirstPoses(Value):
    """Where cameras and boards stand, about.

    Attributes:
        cams_from_rig: (N,), the first is the identity.
        rigs_from_board: (F,).
        turns: (N, F) by which the camera must read the board; 0 where it does not see it.
        tree: the connections that were used.
        doubtful: pairs of cameras of which the board's turn could not be told.
    """

    cams_from_rig: Rigid3
    rigs_from_board: Rigid3
    turns: Int64[np.ndarray, "C F"]
    tree: tuple[Connection, ...]
    doubtful: tuple[tuple[int, int], ...]


def first_poses(
    names: tuple[str, ...], seen: Sequence[CameraFrames], turns: Sequence[BoardTurn], probes: Points3D, min_frames: int
) -> FirstPoses | Rejected:
    """Cameras along the spanning tree of most shared corners, then frames.

    Args:
        names: of the cameras.
        seen: by each of them; every frame is seen by one at least.
        min_frames: that two cameras must share to be connected.
    Returns:
        `cameras_not_connected`, with the groups that are.
    """
    connections = _connections(seen)
    strong = [one for one in connections if len(one.frames) >= min_frames]
    edges = np.array([(one.camera1, one.camera2) for one in strong], np.int64).reshape(-1, 2)
    groups = connected_components(len(names), edges)
    if len(groups) > 1:
        return Rejected("cameras_not_connected", _told_apart(names, groups, connections, min_frames))
    rows = maximum_spanning_tree(len(names), edges, np.array([one.corners for one in strong], np.int64))
    tree = tuple(strong[row] for row in rows)
    found = [relative_pose(_at(seen[one.camera1], one), _at(seen[one.camera2], one), turns, probes) for one in tree]
    mounts = _along(tree, [_square(relative.cam2_from_cam1) for relative in found], len(names))
    poses, chosen = _frames(mounts, seen, turns, probes)
    doubtful = [(one.camera1, one.camera2) for one, relative in zip(tree, found, strict=True) if relative.doubtful]
    return FirstPoses(Rigid3.from_matrix(mounts), Rigid3.from_matrix(poses), chosen, tree, tuple(doubtful))


def _connections(seen: Sequence[CameraFrames]) -> list[Connection]:
    found = []
    for i, one in enumerate(seen):
        for j, other in enumerate(seen[i + 1 :], i + 1):
            frames = np.intersect1d(one.frames, other.frames)
            if len(frames):
                shared = int(np.minimum(one.corners, other.corners)[frames].sum())
                found.append(Connection(i, j, frames, shared))
    return found


def _at(camera: CameraFrames, connection: Connection) -> Rigid3:
    """Its poses in the frames of the connection."""
    return camera.cams_from_board[np.flatnonzero(np.isin(camera.frames, connection.frames))]


def _told_apart(
    names: tuple[str, ...], groups: Sequence[np.ndarray], connections: list[Connection], needed: int
) -> str:
    told = " | ".join(", ".join([names[c] for c in group.tolist()]) for group in groups)
    weak = [
        f"{names[one.camera1]} and {names[one.camera2]} share {len(one.frames)}"
        for one in connections
        if len(one.frames) < needed
    ]
    count = f"{needed} frames that show the board to both are needed to connect two cameras"
    return f"{told}: {count}" + (f"; {', '.join(weak)}" if weak else "; they share none")


def _along(tree: Sequence[Connection], relative: Sequence[FloatArray], count: int) -> FloatArray:
    """`cams_from_rig` (N, 4, 4) by composition from the first camera."""
    known = {0: np.eye(4)}
    while len(known) < count:
        for one, motion in zip(tree, relative, strict=True):
            i, j = one.camera1, one.camera2
            if i in known and j not in known:
                known[j] = motion @ known[i]
            elif j in known and i not in known:
                known[i] = np.linalg.inv(motion) @ known[j]
    return np.stack([known[c] for c in range(count)])


def _frames(
    mounts: FloatArray, seen: Sequence[CameraFrames], turns: Sequence[BoardTurn], probes: Points3D
) -> tuple[FloatArray, Int64[np.ndarray, "C F"]]:
    """Of each frame the pose on which its views agree best (F, 4, 4), and the turns by which they do.

    The camera with the most corners reads the board as it did.
    """
    corners, untwisted, points = np.stack([one.corners for one in seen]), _untwisted(turns), _homogeneous(probes)
    count = corners.shape[1]
    every, anchor = np.arange(count), corners.argmax(0)
    read = np.full((len(seen), len(turns), count, 4, 4), np.nan)
    for c, one in enumerate(seen):
        read[c][:, one.frames] = np.linalg.inv(mounts[c]) @ _square(one.cams_from_board) @ untwisted[:, None]
    put = read @ points
    first = put[anchor, 0, every]
    depth = np.linalg.norm(first[:, :3], axis=1).mean(1)
    apart = _spread(put - first) / depth
    chosen = np.where(np.isnan(apart), np.inf, apart).argmin(1)
    chosen[anchor, every] = 0
    best = put[np.arange(len(seen))[:, None], chosen, every]
    # A view that is not there is as far from all others as can be.
    between = np.minimum(np.nan_to_num(_spread(best[:, None] - best[None]) / depth, nan=_CAP), _CAP)
    medoid = np.where(corners > 0, between.sum(1), np.inf).argmin(0)
    return read[medoid, chosen[medoid, every], every], chosen.astype(np.int64)


def _spread(off: FloatArray) -> FloatArray:
    """Root of the mean squared length of columns (..., 4, M)."""
    return np.sqrt(np.mean(np.sum(off * off, axis=-2), axis=-1))

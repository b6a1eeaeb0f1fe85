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
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from calib.boards import Board
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
_TOLD_APART = 2.0
"""A turn of the board is told from another if its frames agree by this factor better."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardTurn(Value):
    """A turn after which the board looks the same: point `rows[k]` comes to lie where point k was.

    Attributes:
        motion: `motion @ points3D[k] == points3D[rows[k]]`.
    """

    rows: Int64[np.ndarray, " P"]
    motion: Rigid3


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


def board_turns(board: Board) -> tuple[BoardTurn, ...]:
    """The turns of a board that nothing printed on it tells apart; the first is none at all."""
    points = np.asarray(board.points3D)
    quarters = (0,) if board.has_markers else (0, 1, 2, 3)
    if board.kind == "chessboard" and sum(board.grid) % 2:
        quarters = (0,)  # black squares at one end, white ones at the other
    turns = (turn_of(points, quarter) for quarter in quarters)
    return tuple(turn for turn in turns if turn is not None)


def turn_of(points: Points3D, quarters: int) -> BoardTurn | None:
    """So many quarters of a turn about the middle; None where points do not come to lie on points."""
    center = np.append((points[:, :2].min(0) + points[:, :2].max(0)) / 2, 0.0)
    turn = Rotation3.exp(np.array([0.0, 0.0, quarters * np.pi / 2]))
    motion = Rigid3(turn, center - turn @ center)
    apart = np.linalg.norm((motion @ points)[:, None, :2] - points[None, :, :2], axis=2)
    rows = apart.argmin(1)
    fits = apart.min(1).max() < 1e-6 * np.ptp(points[:, :2]) and len(set(rows.tolist())) == len(points)
    return BoardTurn(rows.astype(np.int64), motion) if fits else None


def relative_pose(
    cam1_from_board: Rigid3, cam2_from_board: Rigid3, turns: Sequence[BoardTurn], probes: Points3D
) -> RelativePose:
    """The pose on which most frames agree, averaged over those.

    Args:
        cam1_from_board, cam2_from_board: batches (F,) of the same frames.
        probes: (M, 3) points of the board by which poses are compared.
    """
    frames, readings = len(cam1_from_board), len(turns)
    seen1 = cam1_from_board.rotation.matrix @ probes.T + cam1_from_board.translation[:, :, None]
    read = [cam2_from_board @ _repeated(turn.motion.inverse(), frames) for turn in turns]
    seen2 = np.stack([pose.rotation.matrix @ probes.T + pose.translation[:, :, None] for pose in read])
    depth = np.linalg.norm(seen2, axis=2).mean(2)
    tried = [pose @ cam1_from_board.inverse() for pose in read]
    some = np.unique(np.linspace(0, frames - 1, min(frames, max(_CANDIDATES // readings, 8))).astype(int))

    def angles(motion: Rigid3) -> FloatArray:
        """(G, F) of all readings."""
        put = np.einsum("ij,fjm->fim", motion.rotation.matrix, seen1) + motion.translation[:, None]
        return np.sqrt(np.mean(np.sum((put - seen2) ** 2, axis=2), axis=2)) / depth

    scored = []
    for g, motions in enumerate(tried):
        for f in some.tolist():
            apart = angles(motions[f])
            score = float(np.minimum(apart.min(0), _CAP).sum())
            scored.append((score, float(motions.rotation.angle[f]), g, f, tuple(apart.argmin(0).tolist())))
    best = min(scored)
    alike = [one for one in scored if one[0] <= _TOLD_APART * best[0] + 1e-9 * frames]
    doubtful = len({one[4] for one in alike}) > 1
    _, _, g, f, _ = min(alike, key=lambda one: one[1]) if doubtful else best
    motion = tried[g][f]
    for _ in range(5):
        apart = angles(motion)
        chosen = apart.argmin(0)
        own = Rigid3.stack([tried[h][k] for k, h in enumerate(chosen)])
        motion = _average(motion, own, apart.min(0))
    apart = angles(motion)
    return RelativePose(motion, apart.argmin(0).astype(np.int64), apart.min(0), doubtful)


def _repeated(motion: Rigid3, count: int) -> Rigid3:
    return Rigid3.stack([motion] * count)


def _average(motion: Rigid3, own: Rigid3, apart: Vector) -> Rigid3:
    """One step to the least sum of distances from the motions that agree."""
    typical = float(np.median(apart[apart < _CAP])) if np.any(apart < _CAP) else _CAP
    weights = np.where(apart <= _AGREEING * typical + 1e-12, 1 / np.maximum(apart, 1e-9), 0.0)
    steps = (own.rotation @ _repeated(motion.inverse(), len(own)).rotation).log()
    turn = Rotation3.exp(weights @ steps / weights.sum())
    return Rigid3(turn @ motion.rotation, weights @ own.translation / weights.sum())


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
        rigs_from_board: by frame.
        turns: of each camera, by frame, the turn by which it must read the board.
        tree: the connections that were used.
        doubtful: pairs of cameras of which the board's turn could not be told.
    """

    cams_from_rig: Rigid3
    rigs_from_board: Mapping[int, Rigid3]
    turns: tuple[Mapping[int, int], ...]
    tree: tuple[Connection, ...]
    doubtful: tuple[tuple[int, int], ...]


def first_poses(
    names: tuple[str, ...], poses: Sequence[Mapping[int, Rigid3]], corners: Sequence[Mapping[int, int]],
    turns: Sequence[BoardTurn], probes: Points3D, min_frames: int,
) -> FirstPoses | Rejected:  # fmt: skip
    """Cameras along the spanning tree of most shared corners, then frames.

    Args:
        names: of the cameras.
        poses: of each camera `cam_from_board` by frame.
        corners: how many each camera sees in it.
        min_frames: that two cameras must share to be connected.
    Returns:
        `cameras_not_connected`, with the groups that are.
    """
    connections = _connections(poses, corners)
    strong = [one for one in connections if len(one.frames) >= min_frames]
    edges = np.array([(one.camera1, one.camera2) for one in strong], np.int64).reshape(-1, 2)
    groups = connected_components(len(names), edges)
    if len(groups) > 1:
        return Rejected("cameras_not_connected", _told_apart(names, groups, connections, min_frames))
    rows = maximum_spanning_tree(len(names), edges, np.array([one.corners for one in strong], np.int64))
    tree = tuple(strong[row] for row in rows)
    found = {
        (one.camera1, one.camera2): relative_pose(
            Rigid3.stack([poses[one.camera1][f] for f in one.frames.tolist()]),
            Rigid3.stack([poses[one.camera2][f] for f in one.frames.tolist()]),
            turns,
            probes,
        )
        for one in tree
    }
    cams_from_rig = _along(tree, {pair: relative.cam2_from_cam1 for pair, relative in found.items()}, len(names))
    rigs_from_board, chosen = _frames(cams_from_rig, poses, corners, turns, probes)
    doubtful = tuple(pair for pair, relative in found.items() if relative.doubtful)
    return FirstPoses(Rigid3.stack(cams_from_rig), rigs_from_board, chosen, tree, doubtful)


def _connections(poses: Sequence[Mapping[int, Rigid3]], corners: Sequence[Mapping[int, int]]) -> list[Connection]:
    found = []
    for i in range(len(poses)):
        for j in range(i + 1, len(poses)):
            frames = sorted(poses[i].keys() & poses[j].keys())
            if frames:
                shared = sum(min(corners[i][f], corners[j][f]) for f in frames)
                found.append(Connection(i, j, np.array(frames, np.int64), shared))
    return found


def _told_apart(
    names: tuple[str, ...], groups: Sequence[np.ndarray], connections: list[Connection], needed: int
) -> str:
    told = " | ".join(", ".join([names[c] for c in group.tolist()]) for group in groups)
    weak = [f"{names[one.camera1]} and {names[one.camera2]} share {len(one.frames)}" for one in connections
            if len(one.frames) < needed]  # fmt: skip
    count = f"{needed} frames that show the board to both are needed to connect two cameras"
    return f"{told}: {count}" + (f"; {', '.join(weak)}" if weak else "; they share none")


def _along(tree: Sequence[Connection], relative: Mapping[tuple[int, int], Rigid3], count: int) -> list[Rigid3]:
    """`cams_from_rig` by composition from the first camera."""
    known = {0: Rigid3.identity()}
    while len(known) < count:
        for one in tree:
            i, j = one.camera1, one.camera2
            if i in known and j not in known:
                known[j] = relative[i, j] @ known[i]
            elif j in known and i not in known:
                known[i] = relative[i, j].inverse() @ known[j]
    return [known[c] for c in range(count)]


def _frames(
    cams_from_rig: list[Rigid3], poses: Sequence[Mapping[int, Rigid3]], corners: Sequence[Mapping[int, int]],
    turns: Sequence[BoardTurn], probes: Points3D,
) -> tuple[dict[int, Rigid3], tuple[dict[int, int], ...]]:  # fmt: skip
    """Of each frame the pose on which its views agree best, and the turns by which they do.

    The camera with the most corners reads the board as it did.
    """
    rigs_from_board, chosen = {}, tuple({} for _ in poses)
    for f in sorted({f for one in poses for f in one}):
        views = sorted((c for c in range(len(poses)) if f in poses[c]), key=lambda c: (-corners[c][f], c))
        put: list[Rigid3] = []
        for c in views:
            read = [cams_from_rig[c].inverse() @ poses[c][f] @ turn.motion.inverse() for turn in turns]
            apart = [_apart(one, put[0], probes) if put else 0.0 for one in read]
            chosen[c][f] = int(np.argmin(apart)) if put else 0
            put.append(read[chosen[c][f]])
        totals = [sum(min(_apart(one, other, probes), _CAP) for other in put) for one in put]
        rigs_from_board[f] = put[int(np.argmin(totals))]
    return rigs_from_board, chosen


def _apart(pose1: Rigid3, pose2: Rigid3, probes: Points3D) -> float:
    """How far apart the board's points are, over their distance from the rig."""
    points1, points2 = pose1 @ probes, pose2 @ probes
    off = np.sqrt(np.mean(np.sum((points1 - points2) ** 2, axis=1)))
    return float(off / max(np.linalg.norm(points2, axis=1).mean(), 1e-300))

"""What `calib handeye` says: a file, a table that a person reads, the same as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from calib import __version__
from calib.hand_eye import HandEyeCalibration
from calib.refine_reject import RejectedView
from sfm.core.geometry.rigid import Rigid3

_SHOWN = 12


def _frames(found: HandEyeCalibration) -> tuple[str, str]:
    return ("hand", "base") if found.setup == "eye_in_hand" else ("base", "hand")


def hand_eye_toml(found: HandEyeCalibration, command: str) -> str:
    """Poses as unit quaternions w, x, y, z and translations in metres, b_from_a: x_in_b = R x_in_a + t."""
    mount, world = _frames(found)
    lines = [
        "[handeye]",
        f'setup = "{found.setup}"',
        'unit = "m"',
        f"rms_px = {found.rms_px!r}",
        f"robot_sigma_deg = {math.degrees(found.robot_sigma[0])!r}",
        f"robot_sigma_m = {found.robot_sigma[1]!r}",
        f"command = {json.dumps(command, ensure_ascii=False)}",
        f'version = "{__version__}"',
        "",
        *_pose_lines(f"{mount}_from_cam", found.mount_from_cam),
        f"sigma_rotation = {found.sigma_rotation.tolist()}  # radians, about the camera's axes",
        f"sigma_translation = {found.sigma_position.tolist()}",
        "",
        *_pose_lines(f"{world}_from_board", found.world_from_board),
    ]
    return "\n".join(lines) + "\n"


def _pose_lines(name: str, pose: Rigid3) -> list[str]:
    return [
        f"[{name}]",
        f"rotation = {pose.rotation.wxyz.tolist()}  # w, x, y, z",
        f"translation = {pose.translation.tolist()}",
    ]


def hand_eye_json(found: HandEyeCalibration, left_out: Sequence[RejectedView]) -> dict[str, Any]:
    """Everything that is known."""
    mount, world = _frames(found)
    return {
        "setup": found.setup,
        f"{mount}_from_cam": _pose_json(found.mount_from_cam),
        f"{world}_from_board": _pose_json(found.world_from_board),
        "sigma_rotation_deg": np.degrees(found.sigma_rotation).tolist(),
        "sigma_position_m": found.sigma_position.tolist(),
        "robot_sigma_deg": math.degrees(found.robot_sigma[0]),
        "robot_sigma_m": found.robot_sigma[1],
        "rms_px": found.rms_px,
        "strict_rms_px": found.strict_rms_px,
        "sigma_px": found.sigma_px,
        "converged": found.converged,
        "views": {
            name: {
                "robot_off_deg": math.degrees(float(np.linalg.norm(off[:3]))),
                "robot_off_m": float(np.linalg.norm(off[3:])),
            }
            for name, off in zip(found.names, found.deviations, strict=True)
        },
        "rejected": {view.name: f"{view.reason} {view.detail}".strip() for view in left_out},
        "read_from_the_other_side": list(found.turned),
        "fallbacks": list(found.fallbacks),
    }


def _pose_json(pose: Rigid3) -> dict[str, Any]:
    return {"rotation": pose.rotation.wxyz.tolist(), "translation": pose.translation.tolist()}


def hand_eye_lines(found: HandEyeCalibration, left_out: Sequence[RejectedView]) -> Iterator[str]:
    """The report on the screen."""
    mount, world = _frames(found)
    pose, board = found.mount_from_cam, found.world_from_board
    off = np.linalg.norm(found.deviations[:, :3], axis=1), np.linalg.norm(found.deviations[:, 3:], axis=1)
    yield f"camera in the frame of the {mount} ({mount}_from_cam), from {len(found.names)} photos"
    yield "  position mm   " + _with_sigma(1e3 * pose.translation, 1e3 * found.sigma_position)
    yield "  turned by °   " + _with_sigma(np.degrees(pose.rotation.log()), np.degrees(found.sigma_rotation))
    yield f"board in the frame of the {world}: {1e3 * np.round(board.translation, 6)} mm"
    yield ""
    yield (
        f"robot: ± {math.degrees(found.robot_sigma[0]):.4f}° and ± {1e3 * found.robot_sigma[1]:.4f} mm on each axis; "
        f"worst pose {found.names[int(np.argmax(off[1]))]}: {math.degrees(off[0][np.argmax(off[1])]):.3f}°, "
        f"{1e3 * off[1].max():.3f} mm"
    )
    yield (
        f"rms {found.rms_px:.4f} px with the robot's poses corrected, {found.strict_rms_px:.4f} px as they are; "
        + (f"converged in {found.iterations} steps" if found.converged else "NOT CONVERGED")
    )
    for view in left_out[:_SHOWN]:
        yield f"left out: {view.name}: {f'{view.reason} {view.detail}'.strip()}"
    if len(left_out) > _SHOWN:
        yield f"left out: {len(left_out) - _SHOWN} more photos"
    if found.turned:
        yield f"read from the board's other end, which was undone: {', '.join(found.turned[:_SHOWN])}"
    yield from (f"note: {words}" for words in found.fallbacks)


def _with_sigma(values: np.ndarray, sigmas: np.ndarray) -> str:
    return "   ".join(
        f"{axis} {value:.3f} ± {sigma:.3f}" for axis, value, sigma in zip("xyz", values, sigmas, strict=True)
    )

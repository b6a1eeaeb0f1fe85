"""What is wrong with a calibration, as causes rather than as one number, and what would mend it.

Of the solution, of its views and their poses, of what residuals have in common (see `whiteness`), and of the pixels
that it leaves uncertain.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from calib.coverage import cells_of
from calib.diagnose_changes import OwnCameras, changed_camera
from calib.refine import Calibration
from calib.uncertainty import CalibrationCovariance, covariance, uncertainty_map
from calib.whiteness import whiteness
from sfm.core.arrays import FloatArray, Vector
from sfm.core.errors import Rejected

_CLEAR = 5.0
"""Standard deviations from chance that are told; there are many residuals, and small faults are common."""
_SHARE = 0.1
"""Excess share of the variance that is told: it is a twentieth of the error."""
_BEND_PX = 0.01
"""What a board's shape must add to the error to be told: detection itself shifts corners of flat boards by as much."""
_FEW_VIEWS = 8
_TILT = math.radians(20.0)
_UNCOVERED, _CELLS = 0.25, 8
"""Share of the border, in cells, beyond what any corner covers that is told, and cells of its width."""
_REACH = {True: 1.5, False: 0.5}
"""Squares from the border that corners can come to: of a board that must be seen whole, and of one with marks."""
_WHOLE = 0.95
_VIEW_FACTOR, _VIEW_PX = 2.0, 0.1
"""Times the median error of views, and px, that one is named at."""
_UNCERTAIN_PX = 1.0
_NAMED = 12
"""Photos that a finding names."""


@dataclasses.dataclass(frozen=True, slots=True)
class Finding:
    """A cause: a word to count by, what was measured, and what would mend it. The gravest come first."""

    cause: str
    detail: str
    remedy: str


def board_tilts(found: Calibration) -> tuple[Vector, Vector]:
    """(V,) angles between boards and image, and the directions in the image about which they are tilted, radians."""
    normals = found.cams_from_board.rotation.matrix[:, :, 2]
    normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return np.arccos(np.clip(normals[:, 2], -1, 1)), np.arctan2(normals[:, 1], normals[:, 0])


def diagnose(
    found: Calibration, doubts: CalibrationCovariance | Rejected | None = None, *, is_explained: bool = False
) -> tuple[Finding, ...]:
    """What is wrong, the gravest first; nothing where nothing was found.

    Args:
        doubts: how uncertain it is; by default by views, or its lower bound where these are too few.
        is_explained: a cause is known already for which photos disagree, as that some are turned.
    """
    changed = None if is_explained else changed_camera(found)
    parts = (_views, _poses) if is_explained or changed else (_views, _poses, _shape_of_residuals)
    told = [*_solution(found), *_changes(changed), *(finding for part in parts for finding in part(found))]
    if changed:  # what is a single photo's fault cannot be told from what is its own camera's
        told = [finding for finding in told if finding.cause != "outlier_view"]
    return (*told, *_reach(found, _doubts(found) if doubts is None else doubts))


def diagnose_photos(found: Calibration) -> tuple[Finding, ...]:
    """What is wrong with the photos and the board, whatever the camera."""
    return tuple(finding for part in (_views, _poses, _shape_of_residuals) for finding in part(found))


def _solution(found: Calibration) -> Iterator[Finding]:
    if not found.converged:
        yield Finding(
            "not_converged",
            f"after {found.iterations} iterations a step still promises a lower cost",
            f"take a lens model with fewer coefficients than {found.lens}",
        )
    for words in found.fallbacks:
        yield Finding("fallback", words, "add views that are tilted by 15° to 45°, about both axes")
    limit, worst = found.camera.max_angle, _largest_angle_seen(found)
    corner = _angle_of_image_corner(found)
    if corner is None:
        yield Finding(
            "image_corners_have_no_ray",
            f"the distortion turns back at {math.degrees(limit):.0f}°; corners of the board reach "
            f"{math.degrees(worst):.0f}°",
            "show the board in the corners of the image, or take a lens model with fewer coefficients",
        )


def _changes(changed: OwnCameras | None) -> Iterator[Finding]:
    if changed is None:
        return
    falls = f"the error falls from {px(changed.rms_px)} to {px(changed.own_rms_px)} px"
    if changed.kind == "focal":
        yield Finding(
            "changed_focus",
            f"{_by_how_much(changed)}; with a focal length of its own for each photo {falls}",
            "hold focus and zoom (no autofocus, rings taped) and take the photos anew, or calibrate from those of one "
            "setting alone",
        )
    else:
        yield Finding(
            "moved_principal_point",
            f"{_by_how_much(changed)}; with a principal point of its own for each photo {falls}",
            "switch stabilisers of lens and sensor off, leave photos uncropped, and take them anew",
        )


def _by_how_much(changed: OwnCameras) -> str:
    names, own = changed.names, changed.own
    if changed.apart:
        few = list(changed.apart)
        told = ", ".join(names[v] for v in few[:_NAMED]) + (f" and {len(few) - _NAMED} more" if few[_NAMED:] else "")
        off = own[few].mean(0) - np.delete(own, few, axis=0).mean(0)
        if changed.kind == "focal":
            return f"{told}: the focal length is {100 * math.expm1(off[0]):+.2g} % off that of the other photos"
        return f"{told}: the principal point is ({off[0]:+.1f}, {off[1]:+.1f}) px off that of the other photos"
    if changed.kind == "focal":
        low, high = int(np.argmin(own[:, 0])), int(np.argmax(own[:, 0]))
        part = 100 * math.expm1(own[high, 0] - own[low, 0])
        return f"the focal length differs by {part:.2g} %, least in {names[low]} and most in {names[high]}"
    deviation, sides = np.std(own, axis=0), np.ptp(own, axis=0)
    return f"the principal point moves by {np.hypot(*deviation):.1f} px (rms), over {sides[0]:.0f} × {sides[1]:.0f} px"


def px(length: float) -> str:
    """With two digits at least."""
    return f"{length:.3f}" if length >= 0.1 else f"{length:.2g}"


def _views(found: Calibration) -> Iterator[Finding]:
    count = len(found.observations)
    if count < _FEW_VIEWS:
        yield Finding("few_views", f"{count} views", "take 15 to 30")
    rms = found.view_rms_px
    for v in np.flatnonzero(rms > max(_VIEW_FACTOR * float(np.median(rms)), _VIEW_PX)):
        yield Finding(
            "outlier_view",
            f"{found.observations.names[v]}: {rms[v]:.2f} px where the median view has {np.median(rms):.2f} px",
            "look at its corners: blur, reflections, a moved board",
        )
    lost = len(found.rejected_corners) / max(len(found.rejected_corners) + len(found.residuals), 1)
    if lost > 0.02:
        yield Finding("many_rejected_corners", f"{100 * lost:.1f} % of them", "look at the views that they are in")


def _poses(found: Calibration) -> Iterator[Finding]:
    tilts, directions = board_tilts(found)
    steep, needed = tilts > _TILT, max(3, math.ceil(0.2 * len(tilts)))
    if np.sum(steep) < needed:
        count = int(np.sum(steep))
        yield Finding(
            "few_tilts",
            f"only {count} of {len(tilts)} boards {'is' if count == 1 else 'are'} tilted by more than "
            f"{math.degrees(_TILT):.0f}°, and {needed} should be",
            "tilt the board by 30° to 45°" if count < len(tilts) else "add photos of the board tilted by 30° to 45°",
        )
    else:
        # Tilts to the left and to the right are about one axis: twice the angle tells them apart from up and down.
        spread = abs(np.mean(np.exp(2j * directions[steep])))
        if spread > 0.9:
            yield Finding(
                "tilts_about_one_axis", "boards lean one way only", "tilt the board about the other axis, too"
            )
    yield from _border(found)


def _border(found: Calibration) -> Iterator[Finding]:
    """Of the border of what the board can reach: one that must be seen whole keeps its outermost squares within."""
    margin = _REACH[_is_seen_whole(found)] * _spacing(found)
    width, height = round(found.camera.width - 2 * margin), round(found.camera.height - 2 * margin)
    if min(width, height) <= 0:
        return
    cells = np.zeros((max(1, round(_CELLS * height / width)), _CELLS), bool)
    cells.ravel()[cells_of(found.observations.points2D - margin, width, height, _CELLS)] = True
    bare = 1 - float(np.mean(np.concatenate([cells[0], cells[-1], cells[1:-1, 0], cells[1:-1, -1]])))
    if bare > _UNCOVERED:
        whole = _is_seen_whole(found)
        yield Finding(
            "uncovered_border",
            f"{100 * bare:.0f} % of the border of {'what this board can reach' if whole else 'the image'} has never "
            f"shown a corner, {_bare_sides(cells)}",
            "hold the board there, just whole within the image; from farther away it reaches nearer to the border"
            if whole else "show the board there, close enough to be cut by the border",
        )  # fmt: skip


def _is_seen_whole(found: Calibration) -> bool:
    """Whether views show all of the board, as they must where no markers tell corners apart."""
    counts = np.diff(found.observations.offsets)
    return bool(np.median(counts) >= _WHOLE * len(np.unique(found.observations.rows)))


def _spacing(found: Calibration) -> float:
    """Of corners in the quarter of the views that show them smallest, px."""
    o, spacings = found.observations, []
    for v in range(len(o)):
        points = o.points2D[o.offsets[v] : o.offsets[v + 1]]
        apart = np.sum((points[:, None] - points[None]) ** 2, axis=2)
        np.fill_diagonal(apart, np.inf)
        spacings.append(math.sqrt(float(np.median(apart.min(1)))))
    return float(np.quantile(spacings, 0.25))


def _bare_sides(covered: FloatArray | np.ndarray) -> str:
    sides = {
        "left": covered[:, 0], "right": covered[:, -1], "top": covered[0], "bottom": covered[-1],
    }  # fmt: skip
    return "most of it on the " + max(sides, key=lambda name: float(np.mean(~sides[name])))


def _shape_of_residuals(found: Calibration) -> Iterator[Finding]:
    white = whiteness(found)
    board, image = (share > _SHARE and share > _CLEAR * sigma for share, sigma in (white.board, white.image))
    if board and math.sqrt(white.board[0]) * found.rms_px > _BEND_PX:
        richer = {"flat": "paraboloid or free", "scale": "paraboloid or free", "free": ""}.get(found.shape.kind, "free")
        yield Finding(
            "bent_board",
            f"{100 * white.board[0]:.0f} % of the variance of residuals is corners that lie elsewhere than designed",
            f"let the board's shape be estimated ({richer}), or glue it to glass" if richer else "glue it to glass",
        )
    if image:
        yield Finding(
            "lens_model",
            f"{100 * white.image[0]:.0f} % of the variance of residuals is the same wherever in the image it is seen",
            f"take a lens model with more coefficients than {found.lens}",
        )
    correlation, sigma = white.neighbours
    if not (board or image) and correlation > 2 * _SHARE and correlation > _CLEAR * sigma:
        yield Finding(
            "correlated_corners",
            f"residuals of neighbouring corners are correlated by {correlation:.2f}",
            "standard deviations are too small, take those by views; look for a refinement window that is too large",
        )


def _doubts(found: Calibration) -> CalibrationCovariance | Rejected:
    by_view = covariance(found, by_view=True)
    return covariance(found) if isinstance(by_view, Rejected) else by_view


def _reach(found: Calibration, covariances: CalibrationCovariance | Rejected) -> Iterator[Finding]:
    if isinstance(covariances, Rejected):
        yield Finding(covariances.reason, covariances.detail, f"take a lens model with less than {found.lens} has")
        return
    deviations, pixels = uncertainty_map(found, covariances, across=24)
    worst = float(np.nanmax(deviations)) if np.any(np.isfinite(deviations)) else math.inf
    if worst > _UNCERTAIN_PX:
        u, v = pixels[int(np.nanargmax(deviations))]
        yield Finding(
            "uncertain_corners",
            f"pixels near ({u:.0f}, {v:.0f}) are uncertain by {worst:.1f} px (one standard deviation)",
            "show the board there",
        )


def _largest_angle_seen(found: Calibration) -> float:
    rays, valid = found.camera.unproject(found.observations.points2D)
    return float(np.arccos(np.clip(rays[valid, 2], -1, 1)).max(initial=0.0))


def _angle_of_image_corner(found: Calibration) -> float | None:
    """The largest angle of the image's corners from the axis; None where one of them has no ray.

    A fisheye's circle often ends before the corners: for wide lenses the middles of the sides count.
    """
    w, h = float(found.camera.width), float(found.camera.height)
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]])
    if found.camera.model_info.is_fisheye:
        return 0.0
    rays, valid = found.camera.unproject(corners)
    return float(np.arccos(rays[:, 2]).max()) if np.all(valid) else None

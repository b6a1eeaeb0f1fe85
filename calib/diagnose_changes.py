"""Whether the camera changed between the photos: its focus or zoom, or where the lens stands before the sensor.

A calibration takes one camera for all photos. Here each photo v gets its own as well, one that differs by

    focal length      f_v = f (1 + y_v)
    principal point   c_v = c + y_v

with y_v expected to be near zero, so that photos which say nothing of it (boards parallel to the image leave focal
length and distance open together) leave it there:

    min  Σ_v |e_v(camera with y_v, pose_v)|² / s² + |y_v|² / τ²

over the camera, the poses and all y_v. The noise s is not known, and is far smaller than the errors of one camera for
all if that is wrong; so it is taken from the solution, and the solution found again. Where one camera took the photos
its own one for each explains hardly more than noise; that is what is asked, not whether it explains more than chance:
no lens model is exact, and with many corners anything explains more than chance.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, TypeAlias

import numpy as np

from calib.refine import Calibration
from calib.refine_system import CalibrationSystem, Estimate
from calib.whiteness import whiteness
from sfm.core.arrays import FloatArray, Value
from sfm.core.cameras import Camera
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.levenberg_marquardt import StopRules, Trial, minimize

Changing: TypeAlias = Literal["focal", "center"]
_RULES = StopRules(max_iterations=40, relative_cost_tolerance=1e-5, gradient_tolerance=0.0)
_ROUNDS, _SETTLED = 4, 0.9
_EXPECTED = {"focal": 0.05, "center": 0.02}
"""τ: relative, and by the longer side of the image."""
_FLOOR_PX = 1e-3
_CLEARLY = 0.7
"""Noise with a camera for each photo over that with one for all, below which the camera changed. Eleven sets of photos
that were taken by one come to 0.82 and more; rendered ones whose focus drifts by 2 %, is off by 1.5 % in a third of
them, or whose principal point moves by 4 px, to 0.6 and less."""
_FEWEST = 5
"""Views; of fewer their own cameras explain anything."""
_GAP = 0.5
_MORE = 2.0
"""Times. Of a bent board both explain about as much, of a camera that changed the places of corners explain nothing."""
_DAMPED = 1e-12


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class OwnCameras(Value):
    """Photos with a camera each.

    Attributes:
        own: (V, D) by what each differs: focal length by its logarithm or principal point in px.
        sigmas: (V, D) standard deviations of that.
        rms_px, own_rms_px: root of the mean squared length of whitened residuals, with one camera for all and with one
            for each.
        noise_px, own_noise_px: the same as standard deviations of a coordinate: what is fitted does not count.
        freedom: number of coordinates less that of what is fitted, with one camera for all.
    """

    kind: Changing
    names: tuple[str, ...]
    own: FloatArray
    sigmas: FloatArray
    rms_px: float
    own_rms_px: float
    noise_px: float
    own_noise_px: float
    freedom: int

    @property
    def evidence(self) -> float:
        """The higher, the likelier it is that this changed; only differences count.

        A change explains errors at the price of a number for each photo, by how much better that is known then.
        """
        V, D = self.own.shape
        expected = np.sqrt(np.mean(self.own**2 + self.sigmas**2, axis=0))
        return -self.freedom * math.log(self.own_noise_px) - float(np.log(expected / self.sigmas).sum()) - 0.5 * V * D

    @property
    def apart(self) -> tuple[int, ...]:
        """Photos on the smaller side of the widest gap between them, if that is more than half of all; else none."""
        along = self.own[:, 0]
        if self.own.shape[1] > 1:
            centred = self.own - self.own.mean(0)
            along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        order = np.argsort(along, kind="stable")
        gaps = np.diff(along[order])
        if not len(gaps) or gaps.max() <= _GAP * np.ptp(along):
            return ()
        at = int(np.argmax(gaps)) + 1
        return tuple(sorted(min(order[at:].tolist(), order[:at].tolist(), key=len)))


def changed_camera(found: Calibration) -> OwnCameras | None:
    """What changed between the photos, None where one camera may have taken them all.

    A camera for each photo also makes up for a bent board, and for a part of a poor lens model. So it must explain far
    more than corners would that lie elsewhere on the board, or means over cells of the image.
    """
    if len(found.observations) < _FEWEST:
        return None
    tried = [own_cameras(found, kind) for kind in ("focal", "center") if _can_change(found, kind)]
    clear = [one for one in tried if one.own_noise_px < _CLEARLY * one.noise_px]
    if not clear:
        return None
    best, white = max(clear, key=lambda one: one.evidence), whiteness(found)
    explained = 1 - (best.own_noise_px / best.noise_px) ** 2
    return best if explained > _MORE * max(white.board[0], white.image[0]) else None


def _can_change(found: Calibration, kind: Changing) -> bool:
    info = found.camera.model_info
    return len(info.focal_indices if kind == "focal" else info.principal_point_indices) > 0


def own_cameras(found: Calibration, kind: Changing) -> OwnCameras:
    """The photos of a calibration with a focal length or a principal point of its own for each."""
    count, system = len(found.residuals), _OwnSystem(found, kind)
    fitted = 6 * len(found.observations) + len(found.columns) + len(found.shape.coefficients)
    freedom, own = max(2 * count - fitted, 1), max(2 * count - fitted - system.own.size, 1)
    before = system.squares
    first = system.noise = max(math.sqrt(before / freedom), _FLOOR_PX)
    for _ in range(_ROUNDS):
        last = system.noise
        minimize(system, _RULES)
        system.noise = max(math.sqrt(system.squares / own), _FLOOR_PX)
        if system.noise > _SETTLED * last:
            break
    return OwnCameras(
        kind, found.observations.names, system.own, system.sigmas(), math.sqrt(before / count),
        math.sqrt(system.squares / count), first, system.noise, freedom,
    )  # fmt: skip


@dataclasses.dataclass(slots=True)
class _Point:
    params: FloatArray
    coefficients: FloatArray
    own: FloatArray
    rotations: FloatArray
    translations: FloatArray
    squares: float = math.nan
    blocks: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(0))


class _OwnSystem:
    """A `sfm.core.optim.levenberg_marquardt.System`; the board's shape stays."""

    def __init__(self, found: Calibration, kind: Changing) -> None:
        info, camera = found.camera.model_info, found.camera
        self.noise = 1.0
        self._found, self._kind, self._shared = found, kind, found.columns
        self._places = np.array(info.focal_indices if kind == "focal" else info.principal_point_indices, np.int64)
        self._scale = _EXPECTED[kind] * (1.0 if kind == "focal" else max(camera.width, camera.height))
        self._columns = np.union1d(self._shared, self._places)
        self._shape, self._shape_width = found.shape, len(found.shape.coefficients)
        self._views = [found.observations.of_views([v]) for v in range(len(found.observations))]
        one, width = found.estimate, 1 if kind == "focal" else len(self._places)
        self._now = _Point(
            np.array(camera.params), np.array(found.shape.coefficients), np.zeros((len(self._views), width)),
            np.array(one.rotations), np.array(one.translations),
        )  # fmt: skip
        self._evaluate(self._now)
        self._trial = self._now

    @property
    def squares(self) -> float:
        """Sum of the squared whitened residuals."""
        return self._now.squares

    @property
    def own(self) -> FloatArray:
        """(V, D)."""
        return self._now.own

    def linearize(self) -> tuple[float, float]:
        """Cost, and an entry of the gradient that does not matter."""
        self._normal = self._equations()
        return self._cost(self._now), math.inf

    def try_step(self, damping: float) -> Trial | None:
        """See `System`."""
        H, W, A = (part.copy() for part in self._normal)
        at, shared = np.arange(H.shape[1]), np.arange(len(A) - 1)
        diagonals = H[:, at, at] + _DAMPED * H[:, at, at].max(0), A[shared, shared] + 0.0
        H[:, at, at] += damping * diagonals[0]
        A[shared, shared] += damping * diagonals[1]
        try:
            Y = np.linalg.solve(H, W)
            S = A - np.einsum("vik,vil->kl", W, Y)
            x = -np.linalg.solve(S[:-1, :-1], S[:-1, -1])
        except np.linalg.LinAlgError:
            return None
        z = -(Y[:, :, -1] + Y[:, :, :-1] @ x)
        self._trial = self._moved(x, z)
        slope = float(np.sum(z * self._normal[1][:, :, -1]) + x @ self._normal[2][:-1, -1])
        damped = damping * float(np.sum(z * z * diagonals[0]) + np.sum(x * x * diagonals[1]))
        norm = math.sqrt(float(np.sum(z * z) + x @ x))
        return Trial(self._cost(self._trial), 0.5 * (damped - slope), norm, float(np.linalg.norm(self._now.params)))

    def accept(self) -> None:
        """See `System`."""
        self._now = self._trial

    def sigmas(self) -> FloatArray:
        """(V, D) of what is each view's own, the camera that they share taken for known."""
        H = self._equations()[0]
        variances = np.linalg.inv(H)[:, np.arange(6, H.shape[1]), np.arange(6, H.shape[1])]
        return self.noise * np.sqrt(np.maximum(variances, 0.0))

    def _cost(self, point: _Point) -> float:
        return 0.5 * (point.squares + self.noise**2 * float(np.sum((point.own / self._scale) ** 2)))

    def _camera(self, params: FloatArray, own: FloatArray) -> Camera:
        params = params.copy()
        params[self._places] = params[self._places] * math.exp(own[0]) if self._is_focal else params[self._places] + own
        return self._found.camera.with_params(params)

    @property
    def _is_focal(self) -> bool:
        return self._kind == "focal"

    def _evaluate(self, point: _Point) -> None:
        """Squares, and of each view the block as `CalibrationSystem` has it."""
        systems, shape = [], dataclasses.replace(self._shape, coefficients=point.coefficients)
        for v, view in enumerate(self._views):
            some = slice(v, v + 1)
            camera = self._camera(point.params, point.own[v])
            estimate = Estimate(camera, point.rotations[some], point.translations[some], shape)
            systems.append(
                CalibrationSystem(
                    view, estimate, self._columns, free_shape=self._shape_width > 0, keep_invertible=False
                )
            )
        point.squares = 2 * float(sum(system.view_costs[0] for system in systems))
        point.blocks = np.concatenate([system.blocks for system in systems])

    def _equations(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """H (V, 6 + D, 6 + D) of what is a view's own, W (V, 6 + D, K + 1), A (K + 1, K + 1); gradients come last."""
        now, width = self._now, self._now.own.shape[1]
        lower = np.tril(now.blocks)
        full = lower + np.tril(lower, -1).swapaxes(1, 2)
        views, size = full.shape[:2]
        local, shared = (
            np.zeros((views, size, 6 + width)),
            np.zeros((views, size, len(self._shared) + 1 + self._shape_width)),
        )
        local[:, np.arange(6), np.arange(6)] = 1.0
        rest = np.arange(-1 - self._shape_width, 0)
        shared[:, rest, rest] = 1.0
        own_rows = 6 + np.searchsorted(self._columns, self._places)
        shared_rows = 6 + np.searchsorted(self._columns, self._shared)
        shared[:, shared_rows, np.arange(len(self._shared))] = 1.0
        if self._is_focal:
            factor = np.exp(now.own[:, 0])
            local[:, own_rows, 6] = factor[:, None] * now.params[self._places]
            for row, place in zip(own_rows, self._places, strict=True):
                shared[:, row, np.flatnonzero(self._shared == place)] = factor[:, None]
        else:
            local[:, own_rows, 6 + np.arange(width)] = 1.0
        H = local.swapaxes(1, 2) @ full @ local
        W = local.swapaxes(1, 2) @ full @ shared
        A = (shared.swapaxes(1, 2) @ full @ shared).sum(0)
        weight, at = (self.noise / self._scale) ** 2, np.arange(6, 6 + width)
        H[:, at, at] += weight
        W[:, 6:, -1] += weight * now.own
        return H, W, A

    def _moved(self, x: FloatArray, z: FloatArray) -> _Point:
        now = self._now
        turn = Rotation3.exp(z[:, :3]).matrix
        params = now.params.copy()
        params[self._shared] += x[: len(self._shared)]
        coefficients = now.coefficients + x[len(self._shared) :]
        translations = np.einsum("vij,vj->vi", turn, now.translations) + z[:, 3:6]
        point = _Point(params, coefficients, now.own + z[:, 6:], turn @ now.rotations, translations)
        self._evaluate(point)
        return point

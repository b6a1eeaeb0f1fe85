"""Where everything is during an adjustment: poses, parameters and points as kernels want them, and how they move."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from sfm.bundle import _kernels as kernels
from sfm.bundle.layout import Layout
from sfm.bundle.prior_terms import bias_count
from sfm.bundle.problem import BundleProblem
from sfm.bundle.rig_arrays import RigArrays
from sfm.core.arrays import FloatArray
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.block_pattern import BLOCK


class Frames(NamedTuple):
    """Poses (F, 4), (F, 3), (F, 3, 3) and (F, 3) of the frames; what `turn_poses` moves."""

    wxyz: np.ndarray
    centers: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray

    @property
    def poses(self) -> Rigid3:
        """Of the frames, from the world; a batch (F,)."""
        return Rigid3(Rotation3(self.wxyz.copy()), self.translations.copy())

    def copy(self) -> Frames:
        """With arrays of its own."""
        return Frames(*(part.copy() for part in self))


class Places(NamedTuple):
    """Where a step (rows, 6) has what belongs to parameters, sensors and biases.

    Attributes:
        cells, entries: camera and column of each parameter, and its number among those of the step.
        sensors, sensor_rows: sensors that move and their rows; bias_rows: of the biases.
    """

    cells: tuple[np.ndarray, np.ndarray]
    entries: np.ndarray
    sensors: np.ndarray
    sensor_rows: np.ndarray
    bias_rows: np.ndarray

    @staticmethod
    def of(layout: Layout) -> Places:
        """Those of a problem as laid out."""
        shared, poses = layout.shared, len(layout.slot_frame)
        camera, column, row, place = layout.parameters
        mounted = np.flatnonzero(shared.sensor >= 0)
        return Places(
            (camera, column),
            BLOCK * row + place,
            shared.sensor[mounted],
            poses + mounted,
            poses + np.flatnonzero(shared.bias >= 0),
        )


@dataclasses.dataclass(slots=True)
class State:
    """Parameters as kernels want them; what is constant is the same in both states of a system.

    Attributes:
        images: rotations (I, 3, 3), translations (I, 3) and centres (I, 3) of the images; without rigs, of the frames.
    """

    frames: Frames
    images: tuple[np.ndarray, np.ndarray, np.ndarray]
    sensors: Rigid3
    params: np.ndarray
    points3D: np.ndarray
    biases: np.ndarray
    lost: int = 0

    @staticmethod
    def of(problem: BundleProblem) -> State:
        """Where the problem starts."""
        rigs, poses = problem.rigs, problem.cams_from_world
        moving = poses if rigs is None else rigs.rigs_from_world
        turns = moving.rotation.matrix
        centers = -np.einsum("fji,fj->fi", turns, moving.translation)
        frames = Frames(moving.rotation.wxyz.copy(), centers, turns, moving.translation.copy())
        return State(
            frames,
            (frames.rotations, frames.translations, frames.centers) if rigs is None else _as_arrays(poses),
            Rigid3.identity((0,)) if rigs is None else rigs.sensors_from_rig,
            problem.camera_params.copy(),
            problem.points3D.copy(),
            np.zeros((bias_count(problem.pose_priors), 3)),
        )

    def copy(self) -> State:
        """With arrays of its own where they move."""
        parts = {name: getattr(self, name).copy() for name in ("frames", "params", "points3D", "biases")}
        copied = dataclasses.replace(self, **parts)
        if self.images[0] is self.frames.rotations:
            copied.images = copied.frames.rotations, copied.frames.translations, copied.frames.centers
        return copied

    def mounted(self, rigs: RigArrays) -> RigArrays:
        """`rigs` where they are now."""
        return dataclasses.replace(rigs, rigs_from_world=self.frames.poses, sensors_from_rig=self.sensors)

    def move(self, delta: FloatArray, moving: np.ndarray, places: Places, rigs: RigArrays | None, then: State) -> None:
        """Fills `then` with the poses and parameters after a step (rows, 6) of the reduced system."""
        kernels.turn_poses(moving, delta, *self.frames, *then.frames)
        then.params[places.cells] = self.params[places.cells] + delta.ravel()[places.entries]
        then.biases[:] = self.biases + delta[places.bias_rows, :3]
        if rigs is not None:
            then.sensors = _shifted(self.sensors, places.sensors, delta[places.sensor_rows])
            then.images = _as_arrays(then.mounted(rigs).cams_from_world)


def _as_arrays(poses: Rigid3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return poses.rotation.matrix, poses.translation.copy(), poses.center


def _shifted(sensors: Rigid3, moving: np.ndarray, delta: FloatArray) -> Rigid3:
    """Sensors of which some moved by (ω, υ) on the left: exp(ω) R and exp(ω) t + υ."""
    turn = Rotation3.exp(delta[:, :3])
    turns, translations = sensors.rotation.wxyz.copy(), sensors.translation.copy()
    turns[moving] = (turn @ sensors.rotation[moving]).wxyz
    translations[moving] = turn @ translations[moving] + delta[:, 3:]
    return Rigid3(Rotation3(turns), translations)

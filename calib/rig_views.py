"""What several cameras that are mounted together saw of a board, moment by moment.

A *frame* is a moment: the board stands still, and some of the cameras see it. A *view* is what one camera saw in one
frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from calib.refine_views import BoardView, Observations
from sfm.core.arrays import BoolArray, Value
from sfm.core.cameras import Camera


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigCamera(Value):
    """One camera of a rig, and what it saw.

    Attributes:
        views: of the board, at most one a frame.
        frames: the frame of each view; views of several cameras with the same frame were taken at one moment.
        lens: row of `refine_lenses.LENSES` by which it is calibrated, and refined.
        camera: where it is known already; it is held unless the intrinsics of known cameras are refined, too.

    Raises:
        ValueError: numbers of views and frames differ, or two views are of one frame.
    """

    name: str
    views: tuple[BoardView, ...]
    frames: tuple[str, ...]
    lens: str = "opencv5"
    camera: Camera | None = None

    def __post_init__(self) -> None:
        if len(self.views) != len(self.frames):
            raise ValueError(f"{self.name}: {len(self.views)} views of {len(self.frames)} frames")
        if len(set(self.frames)) < len(self.frames):
            twice = next(frame for frame in self.frames if self.frames.count(frame) > 1)
            raise ValueError(f"{self.name}: two views of the frame {twice!r}")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigObservations(Value):
    """Views of all cameras in flat columns.

    Attributes:
        frames: names of the moments; each has a view at least.
        cameras: (N,) what each camera saw.
        frame_of: (N,) of each camera the frame (V,) of each of its views, none twice.
    """

    frames: tuple[str, ...]
    cameras: tuple[Observations, ...]
    frame_of: tuple[Int64[np.ndarray, " _"], ...]

    @property
    def corner_count(self) -> int:
        """Over all views."""
        return sum(len(camera.rows) for camera in self.cameras)

    @property
    def views_per_frame(self) -> Int64[np.ndarray, " F"]:
        """How many cameras saw each frame."""
        return np.bincount(np.concatenate(self.frame_of), minlength=len(self.frames))

    @property
    def shown(self) -> Int64[np.ndarray, " P"]:
        """How many views show each point of the board."""
        return np.sum([camera.shown for camera in self.cameras], axis=0)

    def of_corners(self, kept: Sequence[BoolArray]) -> RigObservations:
        """Only the corners that are kept, by camera; views and frames stay."""
        some = [camera.of_corners(mask) for camera, mask in zip(self.cameras, kept, strict=True)]
        return dataclasses.replace(self, cameras=tuple(some))

    def of_views(self, kept: Sequence[Sequence[int]]) -> tuple[RigObservations, Int64[np.ndarray, " _"]]:
        """Only these views of each camera, and which of the frames are left."""
        frame_of = [frames[list(views)] for frames, views in zip(self.frame_of, kept, strict=True)]
        left, renamed = np.unique(np.concatenate(frame_of), return_inverse=True)
        parts = np.split(renamed, np.cumsum([len(frames) for frames in frame_of])[:-1])
        some = RigObservations(
            frames=tuple(self.frames[f] for f in left),
            cameras=tuple(camera.of_views(views) for camera, views in zip(self.cameras, kept, strict=True)),
            frame_of=tuple(part.astype(np.int64) for part in parts),
        )
        return some, left

    def of_frames(self, kept: Sequence[int]) -> tuple[RigObservations, Int64[np.ndarray, " _"]]:
        """Only these frames, in their order, and which they are."""
        return self.of_views([np.flatnonzero(np.isin(frames, kept)).tolist() for frames in self.frame_of])

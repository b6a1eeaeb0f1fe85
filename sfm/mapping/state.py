"""What the incremental mapper knows while it runs: one mutable struct of arrays.

Images, cameras and tracks are rows counted from 0 in the sorted order of their ids. A point is named by its track.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from sfm.core.arrays import FloatArray, Points2D
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks
from sfm.mapping import _kernels

_FOCAL_SIGMA = {True: 0.2, False: 0.5}
"""Relative standard deviation of a focal length that EXIF or a file gives, and of a guessed one."""
_PRINCIPAL_POINT_SIGMA = 0.01
"""Of the principal point, relative to the longer side: lenses are mounted this well."""
_DISTORTION_SIGMA = 0.2
"""Of distortion coefficients: a strong lens has 0.3."""


def expected_intrinsics(cameras: tuple[Camera, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (C, K) as they are, and the standard deviations that adjustment holds them with.

    The priors are weak against the thousands of observations of a real model. They matter where the photos leave a
    parameter open: two views with two unknown focal lengths, a flat scene, a distortion that nothing shows.
    """
    expected, sigmas = np.zeros((len(cameras), MAX_PARAMS)), np.full((len(cameras), MAX_PARAMS), np.inf)
    for row, camera in enumerate(cameras):
        info = camera.model_info
        expected[row, : len(camera.params)] = camera.params
        focals = list(info.focal_indices)
        sigmas[row, focals] = _FOCAL_SIGMA[camera.has_prior_focal_length] * camera.params[focals]
        sigmas[row, list(info.principal_point_indices)] = _PRINCIPAL_POINT_SIGMA * max(camera.width, camera.height)
        sigmas[row, list(info.extra_indices)] = _DISTORTION_SIGMA
    return expected, sigmas


@dataclasses.dataclass(slots=True, eq=False)
class Scene:
    """What never changes during mapping: images, their keypoints and the tracks over them.

    Attributes:
        image_ids, image_names, sizes: of each image row; sizes (I, 2) px.
        camera_ids, cameras, image_camera: cameras as they came, and each image's row among them.
        expected_params, param_sigmas: (C, K) what their parameters are expected to be, and how closely.
        offsets, image, feature, xy, scale: tracks as flat columns, `image` as rows; scales of keypoints in px, 0 where
            they are unknown.
        track_of: the track of each observation.
        image_offsets, image_observations: the observations of each image, CSR.
    """

    image_ids: np.ndarray
    image_names: tuple[str, ...]
    sizes: np.ndarray
    camera_ids: np.ndarray
    cameras: tuple[Camera, ...]
    image_camera: np.ndarray
    expected_params: np.ndarray
    param_sigmas: np.ndarray
    keypoints: Mapping[int, Points2D]
    offsets: np.ndarray
    image: np.ndarray
    feature: np.ndarray
    xy: np.ndarray
    scale: np.ndarray
    track_of: np.ndarray
    image_offsets: np.ndarray
    image_observations: np.ndarray

    @staticmethod
    def build(
        tracks: Tracks,
        keypoints: Mapping[int, Points2D],
        cameras: Mapping[int, Camera],
        image_cameras: Mapping[int, int],
        image_names: Mapping[int, str],
        keypoint_scales: Mapping[int, FloatArray] | None = None,
    ) -> Scene:
        """Lays the inputs out in rows."""
        ids = np.array(sorted(image_cameras), np.int32)
        camera_ids = np.array(sorted(set(image_cameras.values())), np.int32)
        image_camera = np.searchsorted(camera_ids, [image_cameras[i] for i in ids.tolist()])
        used = tuple(cameras[c] for c in camera_ids.tolist())
        image = np.searchsorted(ids, tracks.image_ids).astype(np.int32)
        counts = np.array([len(keypoints[i]) for i in ids.tolist()], np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)])
        rows = starts[image] + tracks.feature_ids
        xy = np.concatenate([keypoints[i] for i in ids.tolist()])[rows]
        scales = keypoint_scales or {i: np.zeros(len(keypoints[i])) for i in ids.tolist()}
        scale = np.concatenate([scales[i] for i in ids.tolist()])[rows]
        expected, sigmas = expected_intrinsics(used)
        return Scene(
            image_ids=ids,
            image_names=tuple(image_names[i] for i in ids.tolist()),
            sizes=np.array([(used[c].width, used[c].height) for c in image_camera], np.float64),
            camera_ids=camera_ids,
            cameras=used,
            image_camera=image_camera.astype(np.int32),
            expected_params=expected,
            param_sigmas=sigmas,
            keypoints=keypoints,
            offsets=np.array(tracks.offsets),
            image=image,
            feature=np.array(tracks.feature_ids),
            xy=np.ascontiguousarray(xy, dtype=np.float64),
            scale=scale,
            track_of=tracks.track_ids,
            image_offsets=np.concatenate([[0], np.cumsum(np.bincount(image, minlength=len(ids)))]),
            image_observations=np.argsort(image, kind="stable"),
        )

    def observations_of(self, image: int) -> np.ndarray:
        """Rows of the observations of an image."""
        return self.image_observations[self.image_offsets[image] : self.image_offsets[image + 1]]


@dataclasses.dataclass(slots=True, eq=False)
class State:
    """Poses, intrinsics and points so far; see `_kernels` for the columns.

    `model_ids` and `params` (C, K) are the cameras, rays the unit bearings of the observations under them.
    """

    scene: Scene
    model_ids: np.ndarray
    params: np.ndarray
    ray: np.ndarray
    R: np.ndarray
    t: np.ndarray
    registered: np.ndarray
    points: np.ndarray
    has_point: np.ndarray
    on: np.ndarray

    @staticmethod
    def start(scene: Scene) -> State:
        """No image registered."""
        images, tracks = len(scene.image_ids), len(scene.offsets) - 1
        state = State(
            scene=scene,
            model_ids=np.array([camera.model_info.model_id for camera in scene.cameras], np.int32),
            params=scene.expected_params.copy(),
            ray=np.zeros((len(scene.xy), 3)),
            R=np.tile(np.eye(3), (images, 1, 1)),
            t=np.zeros((images, 3)),
            registered=np.zeros(images, bool),
            points=np.full((tracks, 3), np.nan),
            has_point=np.zeros(tracks, bool),
            on=np.zeros(len(scene.xy), bool),
        )
        state.refresh_rays(range(len(scene.cameras)))
        return state

    def copy(self) -> State:
        """An independent copy, to return to when a step goes wrong."""
        arrays = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return State(**{name: value if name == "scene" else value.copy() for name, value in arrays.items()})

    def become(self, other: State) -> None:
        """Takes over what another state knows; that one must not be used any more."""
        for field in dataclasses.fields(self):
            setattr(self, field.name, getattr(other, field.name))

    def camera(self, row: int) -> Camera:
        """The camera of a row as it stands now."""
        camera = self.scene.cameras[row]
        return dataclasses.replace(camera, params=self.params[row, : len(camera.params)].copy())

    def set_camera(self, row: int, params: np.ndarray) -> None:
        """Changes a camera, and with it the rays of its images."""
        self.params[row, : len(params)] = params
        self.refresh_rays([row])

    def refresh_rays(self, camera_rows: range | list[int]) -> None:
        """Recomputes the rays of these cameras' observations; a pixel without a ray gets NaN."""
        observed_by = self.scene.image_camera[self.scene.image]
        for row in camera_rows:
            rows = np.flatnonzero(observed_by == row)
            self.ray[rows] = self.camera(row).unproject(self.scene.xy[rows])[0]

    def set_pose(self, image: int, cam_from_world: Rigid3) -> None:
        """Registers an image."""
        self.R[image], self.t[image] = cam_from_world.rotation.matrix, cam_from_world.translation
        self.registered[image] = True

    def unregister(self, image: int) -> None:
        """Takes an image out again, and points that only it and one other saw."""
        rows = self.scene.observations_of(image)
        tracks = np.unique(self.scene.track_of[rows[self.on[rows]]])
        self.on[rows] = False
        self.registered[image] = False
        seen = np.bincount(self.scene.track_of[self.on], minlength=len(self.has_point))
        lost = tracks[seen[tracks] < 2]
        self.has_point[lost] = False
        self.on[np.isin(self.scene.track_of, lost)] = False

    def has_observed(self, image: int) -> np.ndarray:
        """Which keypoints (K,) of an image belong to points."""
        rows = self.scene.observations_of(image)
        observed = np.zeros(len(self.scene.keypoints[int(self.scene.image_ids[image])]), bool)
        observed[self.scene.feature[rows[self.on[rows]]]] = True
        return observed

    def registered_views(self) -> np.ndarray:
        """How many registered images each track has (T,)."""
        seen = self.registered[self.scene.image]
        return np.bincount(self.scene.track_of[seen], minlength=len(self.has_point))

    def tracks_seen_by(self, images: np.ndarray) -> np.ndarray:
        """Sorted tracks with an observation in these images, whether they have a point or not."""
        rows = [self.scene.observations_of(int(i)) for i in images]
        return np.unique(self.scene.track_of[np.concatenate(rows)]) if rows else np.zeros(0, np.int64)

    def triangulate(self, tracks: np.ndarray, max_error_px: float, min_angle: float) -> tuple[int, int]:
        """See `_kernels.triangulate_tracks`."""
        s = self.scene
        return _kernels.triangulate_tracks(
            tracks, s.offsets, s.image, s.xy, self.ray, self.on, self.points, self.has_point,
            self.registered, self.R, self.t, s.image_camera, self.model_ids, self.params, max_error_px, min_angle,
        )  # fmt: skip

    def filter(self, tracks: np.ndarray, max_error_px: float, min_angle: float) -> int:
        """See `_kernels.filter_tracks`."""
        s = self.scene
        return _kernels.filter_tracks(
            tracks, s.offsets, s.image, s.xy, self.on, self.points, self.has_point,
            self.R, self.t, s.image_camera, self.model_ids, self.params, max_error_px, min_angle,
        )  # fmt: skip

    def to_reconstruction(self) -> Reconstruction:
        """The model so far, with all keypoints of the registered images; points are black and numbered from 1."""
        s = self.scene
        rows, tracks, on = np.flatnonzero(self.registered), np.flatnonzero(self.has_point), self.on
        used = np.unique(s.image_camera[rows])
        errors = _kernels.mean_errors(
            s.offsets, s.image, s.xy, on, self.points, self.has_point,
            self.R, self.t, s.image_camera, self.model_ids, self.params,
        )  # fmt: skip
        lengths = np.bincount(s.track_of[on], minlength=len(self.has_point))[tracks]
        keypoints = [s.keypoints[i] for i in s.image_ids[rows].tolist()]
        return Reconstruction(
            cameras={int(s.camera_ids[c]): self.camera(int(c)) for c in used},
            image_ids=s.image_ids[rows],
            image_names=tuple(s.image_names[i] for i in rows),
            image_camera_ids=s.camera_ids[s.image_camera[rows]],
            cams_from_world=Rigid3(Rotation3.from_matrix(self.R[rows]), self.t[rows]),
            keypoint_offsets=np.concatenate([[0], np.cumsum([len(k) for k in keypoints], dtype=np.int64)]),
            keypoints=np.concatenate(keypoints) if keypoints else np.zeros((0, 2)),
            points3D=self.points[tracks],
            point_ids=np.arange(1, len(tracks) + 1),
            colors=np.zeros((len(tracks), 3), np.uint8),
            errors=errors[tracks],
            tracks=Tracks(np.concatenate([[0], np.cumsum(lengths)]), s.image_ids[s.image[on]], s.feature[on]),
        )

"""Point scenes with known cameras and matches, without any image: what the mapper sees, exactly."""

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.mapping import build_tracks
from sfm.mapping.state import Scene


def look_at(center: np.ndarray, target: np.ndarray) -> Rigid3:
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Rigid3(Rotation3.from_matrix(rotation), -rotation @ center)


class PointScene:
    """Cameras on an arc round a cloud of points; each image sees all of them, in an order of its own."""

    def __init__(self, images=8, points=400, noise_px=0.0, outliers=0.0, seed=0, spread_deg=60.0):
        rng = np.random.default_rng(seed)
        self.camera = Camera("SIMPLE_RADIAL", 1000, 800, np.array([900.0, 500.0, 400.0, -0.05]), True)
        self.points = rng.uniform(-1, 1, (points, 3))
        angles = np.deg2rad(np.linspace(-spread_deg / 2, spread_deg / 2, images))
        centers = 5 * np.stack([np.sin(angles), 0.2 * np.sin(3 * angles), -np.cos(angles)], 1)
        self.poses = [look_at(c, np.zeros(3)) for c in centers]
        self.keypoints, order = {}, {}
        for i, pose in enumerate(self.poses, start=1):
            xy, valid = self.camera.project(pose @ self.points)
            assert valid.all()
            order[i] = rng.permutation(points)
            self.keypoints[i] = (xy + rng.normal(0, noise_px, xy.shape))[order[i]]
        self.order = order
        pairs = {}
        for i in self.keypoints:
            for j in range(i + 1, images + 1):
                feature_of = np.argsort(order[j])
                matches = np.stack([np.arange(points), feature_of[order[i]]], 1)
                wrong = rng.random(points) < outliers
                matches[wrong, 1] = rng.permutation(matches[wrong, 1])
                motion = self.poses[j - 1] @ self.poses[i - 1].inverse()
                unit = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
                pairs[i, j] = TwoViewGeometry(PairKind.CALIBRATED, matches.astype(np.int32), unit)
        self.view_graph = ViewGraph(pairs)
        self.cameras = {1: self.camera}
        self.image_cameras = dict.fromkeys(self.keypoints, 1)
        self.image_names = {i: f"{i:03d}.jpg" for i in self.keypoints}

    def keep_matches(self, kept) -> None:
        """Drops matches: `kept(i, j, points)` says of the points (M,) of a pair of images which stay matched."""
        pairs = {}
        for (i, j), geometry in self.view_graph.pairs.items():
            stays = kept(i, j, self.order[i][geometry.matches[:, 0]])
            if stays.any():
                pairs[i, j] = TwoViewGeometry(geometry.kind, geometry.matches[stays], geometry.cam2_from_cam1)
        self.view_graph = ViewGraph(pairs)

    def rows(self) -> Scene:
        """The scene in the rows that the mapper works on."""
        tracks = build_tracks(self.view_graph, self.keypoints, min_length=2)
        return Scene.build(tracks, self.keypoints, self.cameras, self.image_cameras, self.image_names)

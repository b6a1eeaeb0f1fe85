"""Features of images in a COLMAP database: keypoints and their descriptors."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Points2D
from sfm.core.scene import Features
from sfm.io import _database_rows as rows_
from sfm.io.sqlite_file import SqliteFile


class FeatureTables(SqliteFile):
    """The tables `keypoints` and `descriptors`."""

    def write_features(self, image_id: int, features: Features) -> None:
        """Stores the features of an image in place of earlier ones; keypoints are rounded to float32."""
        keypoints = np.column_stack([features.points2D, features.scales, features.orientations]).astype("<f4")
        rows, width = features.descriptors.shape
        with self.transaction():
            self._execute(
                "INSERT OR REPLACE INTO keypoints(image_id, rows, cols, data) VALUES (?, ?, ?, ?)",
                (image_id, rows, 4, keypoints.tobytes()),
            )
            self._execute(
                "INSERT OR REPLACE INTO descriptors(image_id, type, rows, cols, data) VALUES (?, ?, ?, ?, ?)",
                (image_id, int(features.kind), rows, width, features.descriptors.tobytes()),
            )

    def read_features(self, image_id: int) -> Features:
        """The features of an image.

        A keypoint with an affine shape (COLMAP's six columns) gives the mean of its two scales, and the direction of
        its first axis; one of two columns has scale and orientation 0.

        Raises:
            ValueError: the image has none.
        """
        keypoints = self._keypoints(image_id)
        rows = self._fetch("SELECT type, rows, cols, data FROM descriptors WHERE image_id = ?", (image_id,))
        if not rows:
            raise ValueError(f"image {image_id} has keypoints but no descriptors")
        kind, count, width, blob = rows[0]
        with self._reading(f"the descriptors of image {image_id}"):
            return Features(
                keypoints[:, :2].astype(np.float64),
                *rows_.scales_and_orientations(keypoints),
                rows_.array(blob, np.uint8, (count, width)),
                rows_.descriptor_kind(kind),
            )

    def read_keypoints(self, image_id: int) -> Points2D:
        """Only the positions of an image's features, in px.

        Raises:
            ValueError: the image has none.
        """
        return self._keypoints(image_id)[:, :2].astype(np.float64)

    def read_keypoint_scales(self, image_id: int) -> FloatArray:
        """Only the scales of an image's features, in px; 0 where the database has none.

        Raises:
            ValueError: the image has none.
        """
        return rows_.scales_and_orientations(self._keypoints(image_id))[0].astype(np.float64)

    def feature_counts(self) -> dict[int, int]:
        """Number of features of every image that has been through extraction, 0 included."""
        return dict(self._fetch("SELECT image_id, rows FROM keypoints ORDER BY image_id"))

    def clear_features(self, image_id: int | None = None) -> None:
        """Forgets the features of one image or of all; its pairs stay until they are cleared as well."""
        for table in ("keypoints", "descriptors"):
            self._delete(table, "image_id", image_id)

    def _keypoints(self, image_id: int) -> np.ndarray:
        rows = self._fetch("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,))
        if not rows:
            raise ValueError(f"image {image_id} has no features")
        count, columns, blob = rows[0]
        with self._reading(f"the keypoints of image {image_id}"):
            if columns not in (2, 4, 6):
                raise ValueError(f"{columns} columns")
            return rows_.array(blob, np.float32, (count, columns))

"""The workspace's store: a COLMAP database, with a few tables of our own.

COLMAP's tables hold cameras, images, rigs and frames, keypoints, descriptors, matches and two-view geometries, so
that COLMAP and all that reads its databases can go on from ours. Tables with the prefix `parallax_` hold what COLMAP
has no place for: keys of finished work, the ledger of decisions, the files behind the images, and per pair the
triangulation angle or the reason for its rejection.

A pair of images i < j has the key  i (2³¹ − 1) + j.  Keypoints are float32 on disk: what is read back is exactly
`as_stored` of what was written, and a run that wants to resume bit for bit works with that from the start.

Threads: one thread writes (it alone may open transactions); any thread may read, and sees what the open transaction
has written. Processes: many may read while one writes (write-ahead log); a second writer waits, then gives up with
`WorkspaceLockedError`.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sfm.core.arrays import FloatArray, Points2D
from sfm.core.cameras import Camera, model_by_id
from sfm.core.errors import FormatError, Rejected
from sfm.core.scene import Features, Matches, PairKind, TwoViewGeometry, ViewGraph
from sfm.io import _database_rows as rows_
from sfm.io.bookkeeping import Bookkeeping, Decision, ImageSource
from sfm.io.database_schema import open_readonly, open_writable
from sfm.io.sqlite_file import translated_errors

__all__ = ["Database", "Decision", "ImageRow", "ImageSource", "as_stored", "pair_id", "pair_of"]

_PAIR_BASE = 2**31 - 1
_CAMERA_SENSOR = 0


@dataclasses.dataclass(frozen=True, slots=True)
class ImageRow:
    """An image as the database knows it; `name` is relative to the image folder, with forward slashes."""

    image_id: int
    name: str
    camera_id: int


def pair_id(image_id1: int, image_id2: int) -> int:
    """COLMAP's key of a pair, the same for both orders.

    Raises:
        ValueError: the images are the same, or an id is outside [0, 2³¹ − 1).
    """
    low, high = sorted((image_id1, image_id2))
    if not 0 <= low < high < _PAIR_BASE:
        raise ValueError(f"images {image_id1} and {image_id2} do not make a pair")
    return low * _PAIR_BASE + high


def pair_of(key: int) -> tuple[int, int]:
    """The image ids i < j of a pair's key."""
    return divmod(key, _PAIR_BASE)


def as_stored(features: Features) -> Features:
    """The features as they come back from the database: keypoints rounded to float32."""
    return dataclasses.replace(features, points2D=features.points2D.astype(np.float32).astype(np.float64))


class Database(Bookkeeping):
    """A COLMAP database; a context manager that closes it. See the module for threads and processes."""

    @staticmethod
    def open(path: Path | str, *, readonly: bool = False) -> Database:
        """Opens the database, and creates it or adds what it lacks unless `readonly`.

        Raises:
            InputError: it is missing and `readonly`, or the system refuses.
            FormatError: the file is no COLMAP database.
            WorkspaceLockedError: another process writes to it, or a later version of Parallax made it.
        """
        path = Path(path)
        with translated_errors(path):
            return Database(open_readonly(path) if readonly else open_writable(path), path)

    # Cameras and images

    def add_camera(self, camera: Camera) -> int:
        """Adds a camera, with the rig of its own that COLMAP expects, and returns its id."""
        with self.transaction():
            camera_id = self._insert(
                "INSERT INTO cameras(model, width, height, params, prior_focal_length) VALUES (?, ?, ?, ?, ?)",
                rows_.camera_row(camera),
            )
            self._execute(
                "INSERT INTO rigs(rig_id, ref_sensor_id, ref_sensor_type) VALUES (?, ?, ?)",
                (self._free_id("rigs", "rig_id", camera_id), camera_id, _CAMERA_SENSOR),
            )
        return camera_id

    def update_camera(self, camera_id: int, camera: Camera) -> None:
        """Replaces a camera.

        Raises:
            ValueError: there is none with this id.
        """
        changed = self._execute(
            "UPDATE cameras SET model = ?, width = ?, height = ?, params = ?, prior_focal_length = ? "
            "WHERE camera_id = ?",
            (*rows_.camera_row(camera), camera_id),
        ).rowcount
        if not changed:
            raise ValueError(f"no camera {camera_id}")

    def assign_camera(self, image_id: int, camera_id: int) -> None:
        """Gives an image another camera, and its frame that camera's rig.

        Raises:
            ValueError: the camera is not there.
        """
        with self.transaction():
            rig_id = self._rig_of(camera_id)
            self._execute("UPDATE images SET camera_id = ? WHERE image_id = ?", (camera_id, image_id))
            of_image = "data_id = ? AND sensor_type = ?"
            self._execute(
                f"UPDATE frames SET rig_id = ? WHERE frame_id IN (SELECT frame_id FROM frame_data WHERE {of_image})",
                (rig_id, image_id, _CAMERA_SENSOR),
            )
            self._execute(
                f"UPDATE frame_data SET sensor_id = ? WHERE {of_image}", (camera_id, image_id, _CAMERA_SENSOR)
            )

    def delete_unused_cameras(self) -> None:
        """Removes the cameras that no image has, with the rigs of their own."""
        unused = "SELECT camera_id FROM cameras WHERE camera_id NOT IN (SELECT camera_id FROM images)"
        with self.transaction():
            self._execute(
                f"DELETE FROM rigs WHERE ref_sensor_type = ? AND ref_sensor_id IN ({unused})", (_CAMERA_SENSOR,)
            )
            self._execute(f"DELETE FROM cameras WHERE camera_id IN ({unused})")

    def cameras(self) -> dict[int, Camera]:
        """All cameras by id, in the order of the ids."""
        rows = self._fetch(
            "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id"
        )
        with self._reading("cameras"):
            return {
                camera_id: Camera(model_by_id(model).name, width, height, rows_.array(params, np.float64), bool(prior))
                for camera_id, model, width, height, params, prior in rows
            }

    def add_image(self, name: str, camera_id: int) -> int:
        """Adds an image, with the frame of its own that COLMAP expects, and returns its id.

        Raises:
            ValueError: the name is taken, or the camera is not there.
        """
        with self.transaction():
            rig_id = self._rig_of(camera_id)
            image_id = self._insert("INSERT INTO images(name, camera_id) VALUES (?, ?)", (name, camera_id))
            frame_id = self._insert(
                "INSERT INTO frames(frame_id, rig_id) VALUES (?, ?)",
                (self._free_id("frames", "frame_id", image_id), rig_id),
            )
            self._execute(
                "INSERT INTO frame_data(frame_id, data_id, sensor_id, sensor_type) VALUES (?, ?, ?, ?)",
                (frame_id, image_id, camera_id, _CAMERA_SENSOR),
            )
        return image_id

    def images(self) -> tuple[ImageRow, ...]:
        """All images, in the order of their ids."""
        rows = self._fetch("SELECT image_id, name, camera_id FROM images ORDER BY image_id")
        return tuple(ImageRow(*row) for row in rows)

    def delete_image(self, image_id: int) -> None:
        """Removes an image with its features, pairs and frame; its camera stays, as do its rows in the ledger."""
        with self.transaction():
            for table in ("matches", "two_view_geometries", "parallax_pairs"):
                self._execute(
                    f"DELETE FROM {table} WHERE pair_id / {_PAIR_BASE} = ?1 OR pair_id % {_PAIR_BASE} = ?1",
                    (image_id,),
                )
            of_image = "data_id = ? AND sensor_type = ?"
            frames = self._fetch(f"SELECT frame_id FROM frame_data WHERE {of_image}", (image_id, _CAMERA_SENSOR))
            self._execute(f"DELETE FROM frame_data WHERE {of_image}", (image_id, _CAMERA_SENSOR))
            for (frame_id,) in frames:
                self._execute(
                    "DELETE FROM frames WHERE frame_id = ?1 "
                    "AND NOT EXISTS (SELECT 1 FROM frame_data WHERE frame_id = ?1)",
                    (frame_id,),
                )
            self._execute(
                "DELETE FROM pose_priors WHERE corr_data_id = ? AND corr_sensor_type = ?", (image_id, _CAMERA_SENSOR)
            )
            for table in ("keypoints", "descriptors", "parallax_images", "images"):
                self._execute(f"DELETE FROM {table} WHERE image_id = ?", (image_id,))

    # Features

    def write_features(self, image_id: int, features: Features) -> None:
        """Stores the features of an image in place of earlier ones; `as_stored` is what will be read back."""
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

    # Pairs

    def write_matches(self, image_id1: int, image_id2: int, matches: Matches) -> None:
        """Stores the putative matches of a pair, none included, in place of earlier ones."""
        indices = _in_key_order(image_id1, image_id2, matches.indices)
        self._execute(
            "INSERT OR REPLACE INTO matches(pair_id, rows, cols, data) VALUES (?, ?, 2, ?)",
            (pair_id(image_id1, image_id2), len(indices), rows_.index_blob(indices)),
        )

    def read_matches(self, image_id1: int, image_id2: int) -> Matches:
        """The putative matches of a pair, columns in the order of the arguments.

        Raises:
            ValueError: the pair was not matched.
        """
        rows = self._fetch("SELECT rows, cols, data FROM matches WHERE pair_id = ?", (pair_id(image_id1, image_id2),))
        if not rows:
            raise ValueError(f"images {image_id1} and {image_id2} were not matched")
        with self._reading(f"the matches of images {image_id1} and {image_id2}"):
            return Matches(_in_key_order(image_id1, image_id2, rows_.indices(*rows[0])))

    def matched_pairs(self) -> tuple[tuple[int, int], ...]:
        """All pairs that were matched, those without a match included, sorted."""
        return tuple(pair_of(key) for (key,) in self._fetch("SELECT pair_id FROM matches ORDER BY pair_id"))

    def match_counts(self) -> dict[tuple[int, int], int]:
        """Number of putative matches of every pair that was matched."""
        return {pair_of(key): n for key, n in self._fetch("SELECT pair_id, rows FROM matches ORDER BY pair_id")}

    def clear_matches(self, pair: tuple[int, int] | None = None) -> None:
        """Forgets the putative matches of one pair or of all."""
        self._delete("matches", "pair_id", pair and pair_id(*pair))

    def write_geometry(self, image_id1: int, image_id2: int, geometry: TwoViewGeometry | Rejected) -> None:
        """Stores the verified geometry of a pair, or why it has none, in place of earlier ones.

        Raises:
            ValueError: `image_id1` is not below `image_id2`.
        """
        key = pair_id(image_id1, image_id2)
        if image_id1 > image_id2:
            raise ValueError(f"a geometry is from the lower image id to the higher, got {image_id1} and {image_id2}")
        if isinstance(geometry, Rejected):
            row = (0, None, rows_.UNDEFINED_KIND, None, None, None, None, None)
            remark = (0.0, geometry.reason, geometry.detail)
        else:
            row, remark = rows_.geometry_row(geometry), (geometry.tri_angle, "", "")
        with self.transaction():
            self._execute(
                "INSERT OR REPLACE INTO two_view_geometries(pair_id, rows, cols, data, config, F, E, H, qvec, tvec) "
                "VALUES (?, ?, 2, ?, ?, ?, ?, ?, ?, ?)",
                (key, *row),
            )
            self._execute(
                "INSERT OR REPLACE INTO parallax_pairs(pair_id, tri_angle, reason, detail) VALUES (?, ?, ?, ?)",
                (key, *remark),
            )

    def read_geometry(self, image_id1: int, image_id2: int) -> TwoViewGeometry | Rejected:
        """The verified geometry of a pair, from the lower image id to the higher, or why it has none.

        Raises:
            ValueError: the pair was not verified.
        """
        rows = self._geometries("WHERE g.pair_id = ?", (pair_id(image_id1, image_id2),))
        for _, geometry in rows:
            return geometry
        raise ValueError(f"images {image_id1} and {image_id2} were not verified")

    def read_view_graph(self) -> ViewGraph:
        """All pairs with a geometry; rejected ones are left out."""
        kept = self._geometries(f"WHERE g.rows > 0 AND g.config > {rows_.UNDEFINED_KIND}")
        return ViewGraph({pair: geometry for pair, geometry in kept if isinstance(geometry, TwoViewGeometry)})

    def verified_pairs(self) -> tuple[tuple[int, int], ...]:
        """All pairs that verification has seen, rejected ones included, sorted."""
        return tuple(pair_of(k) for (k,) in self._fetch("SELECT pair_id FROM two_view_geometries ORDER BY pair_id"))

    def linked_pairs(self) -> tuple[tuple[int, int], ...]:
        """The pairs that verification found to show one place: neither rejected nor held by watermarks only; sorted."""
        unlinked = (rows_.UNDEFINED_KIND, int(PairKind.WATERMARK))
        rows = self._fetch(
            "SELECT pair_id FROM two_view_geometries WHERE rows > 0 AND config NOT IN (?, ?) ORDER BY pair_id", unlinked
        )
        return tuple(pair_of(k) for (k,) in rows)

    def rejected_pairs(self) -> dict[tuple[int, int], Rejected]:
        """The pairs that verification rejected, and why."""
        found = self._geometries(f"WHERE g.rows = 0 OR g.config = {rows_.UNDEFINED_KIND}")
        return {pair: geometry for pair, geometry in found if isinstance(geometry, Rejected)}

    def clear_geometries(self, pair: tuple[int, int] | None = None) -> None:
        """Forgets the verified geometry of one pair or of all."""
        for table in ("two_view_geometries", "parallax_pairs"):
            self._delete(table, "pair_id", pair and pair_id(*pair))

    # What the methods above are made of

    def _rig_of(self, camera_id: int) -> int:
        rigs = self._fetch(
            "SELECT rig_id FROM rigs WHERE ref_sensor_id = ? AND ref_sensor_type = ?", (camera_id, _CAMERA_SENSOR)
        )
        if not rigs:
            raise ValueError(f"no camera {camera_id} that is the reference of a rig")
        return rigs[0][0]

    def _free_id(self, table: str, column: str, wanted: int) -> int | None:
        """`wanted`, or None (SQLite then chooses) where another program's rows have taken it."""
        return None if self._fetch(f"SELECT 1 FROM {table} WHERE {column} = ?", (wanted,)) else wanted

    def _keypoints(self, image_id: int) -> np.ndarray:
        rows = self._fetch("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,))
        if not rows:
            raise ValueError(f"image {image_id} has no features")
        count, columns, blob = rows[0]
        with self._reading(f"the keypoints of image {image_id}"):
            if columns not in (2, 4, 6):
                raise ValueError(f"{columns} columns")
            return rows_.array(blob, np.float32, (count, columns))

    def _geometries(
        self, where: str, values: tuple[Any, ...] = ()
    ) -> Iterator[tuple[tuple[int, int], TwoViewGeometry | Rejected]]:
        rows = self._fetch(
            "SELECT g.pair_id, g.config, g.rows, g.cols, g.data, g.F, g.E, g.H, g.qvec, g.tvec, "
            "p.tri_angle, p.reason, p.detail FROM two_view_geometries g "
            f"LEFT JOIN parallax_pairs p ON p.pair_id = g.pair_id {where} ORDER BY g.pair_id",
            values,
        )
        for key, *row in rows:
            i, j = pair_of(key)
            with self._reading(f"the geometry of images {i} and {j}"):
                geometry = rows_.geometry(*row)
            yield (i, j), geometry

    @contextlib.contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Turns the refusal of a value's constructor into one that names the file."""
        try:
            yield
        except (ValueError, TypeError) as error:
            raise FormatError(f"{what} cannot be read: {error}", path=self.path) from error


def _in_key_order(image_id1: int, image_id2: int, indices: np.ndarray) -> np.ndarray:
    return indices if image_id1 < image_id2 else indices[:, ::-1]

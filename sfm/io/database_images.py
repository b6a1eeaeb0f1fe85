"""Cameras and images in a COLMAP database, each camera with a rig and each image with a frame of its own."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.cameras import Camera, model_by_id
from sfm.io import _database_rows as rows_
from sfm.io.sqlite_file import SqliteFile

CAMERA_SENSOR = 0
"""COLMAP's type of sensors that are cameras."""


@dataclasses.dataclass(frozen=True, slots=True)
class ImageRow:
    """An image as the database knows it; `name` is relative to the image folder, with forward slashes."""

    image_id: int
    name: str
    camera_id: int


class ImageTables(SqliteFile):
    """The tables `cameras`, `images`, `rigs`, `frames` and `frame_data`."""

    def add_camera(self, camera: Camera) -> int:
        """Adds a camera, with the rig of its own that COLMAP expects, and returns its id."""
        with self.transaction():
            camera_id = self._insert(
                "INSERT INTO cameras(model, width, height, params, prior_focal_length) VALUES (?, ?, ?, ?, ?)",
                rows_.camera_row(camera),
            )
            self._execute(
                "INSERT INTO rigs(rig_id, ref_sensor_id, ref_sensor_type) VALUES (?, ?, ?)",
                (self._free_id("rigs", "rig_id", camera_id), camera_id, CAMERA_SENSOR),
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
                (rig_id, image_id, CAMERA_SENSOR),
            )
            self._execute(f"UPDATE frame_data SET sensor_id = ? WHERE {of_image}", (camera_id, image_id, CAMERA_SENSOR))

    def delete_unused_cameras(self) -> None:
        """Removes the cameras that no image has, with the rigs of their own."""
        unused = "SELECT camera_id FROM cameras WHERE camera_id NOT IN (SELECT camera_id FROM images)"
        with self.transaction():
            self._execute(
                f"DELETE FROM rigs WHERE ref_sensor_type = ? AND ref_sensor_id IN ({unused})", (CAMERA_SENSOR,)
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
                (frame_id, image_id, camera_id, CAMERA_SENSOR),
            )
        return image_id

    def images(self) -> tuple[ImageRow, ...]:
        """All images, in the order of their ids."""
        rows = self._fetch("SELECT image_id, name, camera_id FROM images ORDER BY image_id")
        return tuple(ImageRow(*row) for row in rows)

    def _rig_of(self, camera_id: int) -> int:
        rigs = self._fetch(
            "SELECT rig_id FROM rigs WHERE ref_sensor_id = ? AND ref_sensor_type = ?", (camera_id, CAMERA_SENSOR)
        )
        if not rigs:
            raise ValueError(f"no camera {camera_id} that is the reference of a rig")
        return rigs[0][0]

    def _free_id(self, table: str, column: str, wanted: int) -> int | None:
        """`wanted`, or None (SQLite then chooses) where another program's rows have taken it."""
        return None if self._fetch(f"SELECT 1 FROM {table} WHERE {column} = ?", (wanted,)) else wanted

"""The workspace's store: a COLMAP database, with a few tables of our own.

COLMAP's tables hold cameras, images, rigs and frames, keypoints, descriptors, matches and two-view geometries, so
that COLMAP and all that reads its databases can go on from ours. Tables with the prefix `parallax_` hold what COLMAP
has no place for: keys of finished work, the ledger of decisions, the files behind the images, and per pair the
triangulation angle or the reason for its rejection.

Keypoints are float32 on disk. Stages work with what is read back, never with what was written: so a run that resumes
comes to the same result, bit for bit.

Threads: one thread writes (it alone may open transactions); any thread may read, and sees what the open transaction
has written. Processes: many may read while one writes (write-ahead log); a second writer waits, then gives up with
`WorkspaceLockedError`.
"""

from __future__ import annotations

from pathlib import Path

from sfm.io.bookkeeping import Bookkeeping
from sfm.io.database_features import FeatureTables
from sfm.io.database_images import CAMERA_SENSOR, ImageTables
from sfm.io.database_pairs import PAIR_BASE, PairTables
from sfm.io.database_schema import open_readonly, open_writable
from sfm.io.sqlite_file import translated_errors


class Database(ImageTables, FeatureTables, PairTables, Bookkeeping):
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

    def delete_image(self, image_id: int) -> None:
        """Removes an image with its features, pairs and frame; its camera stays, as do its rows in the ledger."""
        with self.transaction():
            for table in ("matches", "two_view_geometries", "parallax_pairs"):
                self._execute(
                    f"DELETE FROM {table} WHERE pair_id / {PAIR_BASE} = ?1 OR pair_id % {PAIR_BASE} = ?1",
                    (image_id,),
                )
            of_image = "data_id = ? AND sensor_type = ?"
            frames = self._fetch(f"SELECT frame_id FROM frame_data WHERE {of_image}", (image_id, CAMERA_SENSOR))
            self._execute(f"DELETE FROM frame_data WHERE {of_image}", (image_id, CAMERA_SENSOR))
            for (frame_id,) in frames:
                self._execute(
                    "DELETE FROM frames WHERE frame_id = ?1 "
                    "AND NOT EXISTS (SELECT 1 FROM frame_data WHERE frame_id = ?1)",
                    (frame_id,),
                )
            self._execute(
                "DELETE FROM pose_priors WHERE corr_data_id = ? AND corr_sensor_type = ?", (image_id, CAMERA_SENSOR)
            )
            for table in ("keypoints", "descriptors", "parallax_images", "images"):
                self._execute(f"DELETE FROM {table} WHERE image_id = ?", (image_id,))

"""What Parallax itself keeps in the database: files, keys of finished work, decisions, notes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

from sfm.io.sqlite_file import SqliteFile


@dataclasses.dataclass(frozen=True, slots=True)
class ImageSource:
    """The file behind an image: a digest of its content, and what tells quickly that it has not changed.

    `orientation` is the EXIF value, 1 to 8.
    """

    digest: str
    size: int
    mtime_ns: int
    orientation: int = 1


@dataclasses.dataclass(frozen=True, slots=True)
class Decision:
    """A row of the ledger: at `gate`, `item` had `value` against `threshold`, hence `verdict`.

    `item` is an image's name, or two names joined by a tab for a pair (a name cannot hold one).
    """

    stage: str
    item: str
    gate: str
    value: float | None
    threshold: float | None
    verdict: str
    detail: str = ""


class Bookkeeping(SqliteFile):
    """The tables with the prefix `parallax_`, save that of the pairs."""

    # Files behind the images

    def write_source(self, image_id: int, source: ImageSource) -> None:
        """Notes the file that an image was read from."""
        self._execute(
            "INSERT OR REPLACE INTO parallax_images(image_id, digest, size, mtime_ns, orientation) "
            "VALUES (?, ?, ?, ?, ?)",
            (image_id, *dataclasses.astuple(source)),
        )

    def sources(self) -> dict[int, ImageSource]:
        """The files that the images were read from, by image id."""
        rows = self._fetch(
            "SELECT image_id, digest, size, mtime_ns, orientation FROM parallax_images ORDER BY image_id"
        )
        return {image_id: ImageSource(*source) for image_id, *source in rows}

    # Keys of finished work

    def stage_keys(self, stage: str) -> dict[str, str]:
        """The key under which each item of a stage was finished."""
        return dict(self._fetch("SELECT item, key FROM parallax_stages WHERE stage = ? ORDER BY item", (stage,)))

    def set_stage_keys(self, stage: str, keys: Mapping[str, str]) -> None:
        """Notes that items of a stage are finished, each under a key that stands for its inputs and settings."""
        rows = [(stage, item, key) for item, key in keys.items()]
        with self.transaction():
            self._execute_many("INSERT OR REPLACE INTO parallax_stages(stage, item, key) VALUES (?, ?, ?)", rows)

    def clear_stage(self, stage: str, items: Iterable[str] | None = None) -> None:
        """Forgets that items of a stage, or all of them, are finished."""
        with self.transaction():
            if items is None:
                self._delete("parallax_stages", "stage", stage)
            else:
                rows = [(stage, item) for item in items]
                self._execute_many("DELETE FROM parallax_stages WHERE stage = ? AND item = ?", rows)

    # The ledger

    def record(self, *decisions: Decision) -> None:
        """Adds decisions to the ledger."""
        with self.transaction():
            self._execute_many(
                "INSERT INTO parallax_ledger(stage, item, gate, value, threshold, verdict, detail) "
                "VALUES (?, ?, ?, ?, ?, ?, ?)",
                [dataclasses.astuple(decision) for decision in decisions],
            )

    def ledger(self, item: str | None = None, *, stage: str | None = None) -> tuple[Decision, ...]:
        """The decisions about an item, or in a stage, or all; in the order in which they were recorded."""
        rows = self._fetch(
            "SELECT stage, item, gate, value, threshold, verdict, detail FROM parallax_ledger "
            "WHERE (?1 IS NULL OR item = ?1) AND (?2 IS NULL OR stage = ?2) ORDER BY row_id",
            (item, stage),
        )
        return tuple(Decision(*row) for row in rows)

    def clear_ledger(self, stage: str, items: Iterable[str] | None = None) -> None:
        """Forgets the decisions of a stage about some items, or about all; before they are taken anew."""
        with self.transaction():
            if items is None:
                self._delete("parallax_ledger", "stage", stage)
            else:
                rows = [(stage, item) for item in items]
                self._execute_many("DELETE FROM parallax_ledger WHERE stage = ? AND item = ?", rows)

    # Notes

    def meta(self) -> dict[str, str]:
        """All notes by key, `schema_version` among them."""
        return dict(self._fetch("SELECT key, value FROM parallax_meta ORDER BY key"))

    def set_meta(self, key: str, value: str) -> None:
        """Stores a note."""
        self._execute("INSERT OR REPLACE INTO parallax_meta(key, value) VALUES (?, ?)", (key, value))

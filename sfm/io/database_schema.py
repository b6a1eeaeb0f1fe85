"""Opening a database: COLMAP's tables, made by COLMAP itself, and those of Parallax beside them."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

from sfm.core.errors import FormatError, InputError, WorkspaceLockedError
from sfm.io.atomic import os_errors
from sfm.io.sqlite_file import connect

SCHEMA_VERSION = 1
"""Of the `parallax_` tables; a database of another version is refused."""

_COLMAP_TABLES = frozenset(
    (
        *("cameras", "images", "rigs", "rig_sensors", "frames", "frame_data", "pose_priors"),
        *("keypoints", "descriptors", "matches", "two_view_geometries"),
    )
)
_PARALLAX_TABLES = {
    "parallax_meta": "key TEXT PRIMARY KEY, value TEXT NOT NULL",
    "parallax_images": "image_id INTEGER PRIMARY KEY, digest TEXT NOT NULL, size INTEGER NOT NULL, "
    "mtime_ns INTEGER NOT NULL, orientation INTEGER NOT NULL",
    "parallax_pairs": "pair_id INTEGER PRIMARY KEY, tri_angle REAL NOT NULL, reason TEXT NOT NULL, "
    "detail TEXT NOT NULL",
    "parallax_stages": "stage TEXT NOT NULL, item TEXT NOT NULL, key TEXT NOT NULL, PRIMARY KEY (stage, item)",
    "parallax_ledger": "row_id INTEGER PRIMARY KEY, stage TEXT NOT NULL, item TEXT NOT NULL, gate TEXT NOT NULL, "
    "value REAL, threshold REAL, verdict TEXT NOT NULL, detail TEXT NOT NULL",
}
_INDEX = "CREATE INDEX IF NOT EXISTS parallax_ledger_item ON parallax_ledger (item)"


def open_writable(path: Path) -> sqlite3.Connection:
    """A connection to a database that has all tables; they are made where they are missing."""
    if path.is_dir():
        raise InputError("is a folder, not a database", path=path, remedy="choose another workspace")
    with os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    if _lacks_colmap_tables(path):
        _create_colmap_tables(path)
    connection = connect(path, "mode=rw")
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        # With a write-ahead log a kill loses nothing, and a power cut at most the last transactions.
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA foreign_keys = ON")
        if "parallax_meta" not in _tables(connection):
            _create_parallax_tables(connection)
        _check_version(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def open_readonly(path: Path) -> sqlite3.Connection:
    """A connection that cannot write, to a database of ours or of COLMAP's."""
    if not path.is_file():
        raise InputError("there is no database", path=path, remedy="check the path, or run `sfm run` first")
    connection = connect(path, "mode=ro")
    try:
        tables = _tables(connection)
    except sqlite3.OperationalError:
        # A write-ahead log needs a writable folder even to read; without a log the file alone is the truth.
        connection.close()
        log = path.with_name(path.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise
        connection = connect(path, "immutable=1")
        tables = _tables(connection)
    try:
        if not tables >= _COLMAP_TABLES:
            raise FormatError("is no COLMAP database of version 3.12 or later", path=path)
        if "parallax_meta" in tables:
            _check_version(connection, path)
        else:
            # Our readers join our tables, so that a foreign database gets empty ones, in memory only.
            for name, columns in _PARALLAX_TABLES.items():
                connection.execute(f"CREATE TEMP TABLE {name} ({columns})")
    except BaseException:
        connection.close()
        raise
    return connection


def _tables(connection: sqlite3.Connection) -> set[str]:
    return {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}


def _lacks_colmap_tables(path: Path) -> bool:
    if not path.exists() or not path.stat().st_size:
        return True
    with contextlib.closing(connect(path, "mode=rw")) as connection:
        tables = _tables(connection)
    foreign = {name for name in tables if not name.startswith(("sqlite_", "parallax_"))}
    if foreign and not foreign & _COLMAP_TABLES:
        raise FormatError("is an SQLite file, but no COLMAP database", path=path)
    return not tables >= _COLMAP_TABLES


def _create_colmap_tables(path: Path) -> None:
    """Makes COLMAP's tables, or brings those of an earlier version up to date."""
    import pycolmap

    with os_errors(path), path.open("ab"):
        pass  # where this fails, COLMAP would write a log of its own to the screen
    try:
        pycolmap.Database.open(path).close()
    except (RuntimeError, ValueError) as error:
        raise InputError(
            "the database cannot be created", path=path, remedy="check that its folder can be written to"
        ) from error


def _create_parallax_tables(connection: sqlite3.Connection) -> None:
    connection.execute("BEGIN IMMEDIATE")
    for name, columns in _PARALLAX_TABLES.items():
        connection.execute(f"CREATE TABLE IF NOT EXISTS {name} ({columns})")
    connection.execute(_INDEX)
    connection.execute("INSERT OR IGNORE INTO parallax_meta VALUES ('schema_version', ?)", (str(SCHEMA_VERSION),))
    connection.execute("COMMIT")


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    rows = connection.execute("SELECT value FROM parallax_meta WHERE key = 'schema_version'").fetchall()
    if rows != [(str(SCHEMA_VERSION),)]:
        found = rows[0][0] if rows else "unknown"
        raise WorkspaceLockedError(
            f"is of schema version {found}, this program reads {SCHEMA_VERSION}",
            path=path,
            remedy="use the version of Parallax that made it, or start a new workspace",
        )

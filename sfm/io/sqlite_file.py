"""An SQLite file: one connection, transactions, and errors that a user can act upon."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from sfm.core.errors import FormatError, InputError, SfmError, WorkspaceLockedError

_BUSY_TIMEOUT_S = 10.0


File = TypeVar("File", bound="SqliteFile")


class SqliteFile:
    """A connection that several threads may use, one statement at a time; a context manager that closes it."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self.path = path
        self._connection = connection
        self._lock = threading.RLock()

    def close(self) -> None:
        """Ends the connection; a transaction that is open is undone."""
        with self._lock:
            self._connection.close()

    def __enter__(self: File) -> File:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written within is kept together, or not at all if the block raises or the process dies.

        Transactions do not nest: an inner one is part of the outer.
        """
        if self._connection.in_transaction:
            yield
            return
        self._execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            # SQLite has undone it already where, for instance, the disk was full.
            if self._connection.in_transaction:
                self._execute("ROLLBACK")
            raise
        self._execute("COMMIT")

    def _execute(self, sql: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        with self._lock, translated_errors(self.path):
            return self._connection.execute(sql, values)

    def _execute_many(self, sql: str, rows: list[tuple[Any, ...]]) -> None:
        with self._lock, translated_errors(self.path):
            self._connection.executemany(sql, rows)

    def _fetch(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._lock, translated_errors(self.path):
            return self._connection.execute(sql, values).fetchall()

    def _insert(self, sql: str, values: tuple[Any, ...]) -> int:
        row_id = self._execute(sql, values).lastrowid
        assert row_id is not None
        return row_id

    def _delete(self, table: str, column: str, value: int | str | None) -> None:
        if value is None:
            self._execute(f"DELETE FROM {table}")
        else:
            self._execute(f"DELETE FROM {table} WHERE {column} = ?", (value,))

    @contextlib.contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Turns the refusal of a value's constructor into one that names the file."""
        try:
            yield
        except (ValueError, TypeError) as error:
            raise FormatError(f"{what} cannot be read: {error}", path=self.path) from error


def connect(path: Path, options: str) -> sqlite3.Connection:
    """A connection without implicit transactions; `options` as in an SQLite URI, e.g. `mode=ro`."""
    return sqlite3.connect(
        f"{path.absolute().as_uri()}?{options}",
        uri=True,
        timeout=_BUSY_TIMEOUT_S,
        isolation_level=None,
        check_same_thread=False,
    )


@contextlib.contextmanager
def translated_errors(path: Path) -> Iterator[None]:
    """Turns SQLite's errors into ours."""
    try:
        yield
    except sqlite3.IntegrityError as error:
        raise ValueError(f"{path}: {error}") from error
    except (sqlite3.ProgrammingError, sqlite3.InternalError):
        raise
    except sqlite3.DatabaseError as error:
        raise _translation(error, path) from error


def _translation(error: sqlite3.DatabaseError, path: Path) -> SfmError:
    cause = str(error)
    if "locked" in cause or "busy" in cause:
        return WorkspaceLockedError(
            "another process writes to the database", path=path, remedy="wait until it has ended, then try again"
        )
    if not isinstance(error, sqlite3.OperationalError) or "malformed" in cause:
        return FormatError(f"is no sound SQLite database ({cause})", path=path, remedy="remove it and run again")
    return InputError(cause, path=path, remedy="check the permissions of its folder and the space on the disk")

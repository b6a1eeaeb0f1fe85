"""Pairs of images in a COLMAP database: putative matches and verified geometries.

A pair of images i < j has the key  i (2³¹ − 1) + j.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sfm.core.errors import Rejected
from sfm.core.scene import Matches, PairKind, TwoViewGeometry, ViewGraph
from sfm.io import _database_rows as rows_
from sfm.io.sqlite_file import SqliteFile

PAIR_BASE = 2**31 - 1


def pair_id(image_id1: int, image_id2: int) -> int:
    """COLMAP's key of a pair, the same for both orders.

    Raises:
        ValueError: the images are the same, or an id is outside [0, 2³¹ − 1).
    """
    low, high = sorted((image_id1, image_id2))
    if not 0 <= low < high < PAIR_BASE:
        raise ValueError(f"images {image_id1} and {image_id2} do not make a pair")
    return low * PAIR_BASE + high


def pair_of(key: int) -> tuple[int, int]:
    """The image ids i < j of a pair's key."""
    return divmod(key, PAIR_BASE)


class PairTables(SqliteFile):
    """The tables `matches`, `two_view_geometries` and `parallax_pairs`."""

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


def _in_key_order(image_id1: int, image_id2: int, indices: np.ndarray) -> np.ndarray:
    return indices if image_id1 < image_id2 else indices[:, ::-1]

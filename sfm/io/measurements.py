"""What a user measured in the scene, as tables with commas: positions, directions, distances, control points.

The first line names the columns, in any order; empty lines and those that begin with # are passed over.

    name,x,y,z[,sx,sy,sz]                    where a photo was taken, in the units and the frame of the scene to be
    name,latitude,longitude[,altitude,…]     the same in degrees and metres, WGS84; sx, sy, sz are east, north, up
    name,x,y,z[,sigma_deg]                   which way is down, in the camera: x right, y down, z forward
    name1,name2,distance[,sigma]             how far apart two photos were taken
    point,x,y,z[,sx,sy,sz]                   where a point lies: one of the model by its id, or one that is marked
    point,name,x,y                           where a point is marked in a photo, in px, the first centre (0.5, 0.5)

An empty z, altitude or sigma is one that was not measured, or not given.
"""

from __future__ import annotations

import csv
import dataclasses
import difflib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Value, readonly
from sfm.core.errors import FormatError
from sfm.io.atomic import os_errors

_PLACE, _GEODETIC = ("x", "y", "z"), ("latitude", "longitude", "altitude")
_SIGMAS = ("sx", "sy", "sz")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MeasuredPositions(Value):
    """Where photos were taken.

    Attributes:
        names: (k,) of the photos.
        places: (k, 3) x, y, z; or latitude and longitude in degrees and height in metres. NaN where not measured.
        sigmas: (k, 3) along x, y, z or east, north, up; NaN where not given.
        geodetic: which of the two.
    """

    names: tuple[str, ...]
    places: Float64[np.ndarray, "k 3"]
    sigmas: Float64[np.ndarray, "k 3"]
    geodetic: bool = False

    def __post_init__(self) -> None:
        for name in ("places", "sigmas"):
            object.__setattr__(self, name, readonly(getattr(self, name), (len(self.names), 3)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MeasuredDirections(Value):
    """Which way is down: unit vectors (k, 3) in the cameras; sigmas_deg (k,), NaN where not given."""

    names: tuple[str, ...]
    directions: Float64[np.ndarray, "k 3"]
    sigmas_deg: Float64[np.ndarray, " k"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "directions", readonly(self.directions, (len(self.names), 3)))
        object.__setattr__(self, "sigmas_deg", readonly(self.sigmas_deg, (len(self.names),)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MeasuredDistances(Value):
    """How far apart photos were taken: distances and sigmas (k,), NaN where not given."""

    names: tuple[tuple[str, str], ...]
    distances: Float64[np.ndarray, " k"]
    sigmas: Float64[np.ndarray, " k"]

    def __post_init__(self) -> None:
        for name in ("distances", "sigmas"):
            object.__setattr__(self, name, readonly(getattr(self, name), (len(self.names),)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ControlPoints(Value):
    """Where points lie: positions (k, 3), NaN where not measured, and sigmas (k, 3), NaN where not given."""

    labels: tuple[str, ...]
    positions: Float64[np.ndarray, "k 3"]
    sigmas: Float64[np.ndarray, "k 3"]

    def __post_init__(self) -> None:
        for name in ("positions", "sigmas"):
            object.__setattr__(self, name, readonly(getattr(self, name), (len(self.labels), 3)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Marks(Value):
    """Where points are marked in photos: the label of the point and the name of the photo of each, points2D (k, 2)."""

    labels: tuple[str, ...]
    names: tuple[str, ...]
    points2D: Float64[np.ndarray, "k 2"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points2D", readonly(self.points2D, (len(self.labels), 2)))
        if len(self.names) != len(self.labels):
            raise ValueError(f"{len(self.names)} names for {len(self.labels)} marks")


def read_positions(path: Path | str) -> MeasuredPositions:
    """Where photos were taken; a photo occurs once.

    Raises:
        InputError: the file cannot be opened.
        FormatError: a column is missing or unknown, or a value is not a number, out of its range or told twice.
    """
    table = _Table.read(path, ("name",), (_PLACE, _GEODETIC), _SIGMAS, may_lack=("altitude",))
    geodetic = "latitude" in table.columns
    x, y, z = _GEODETIC if geodetic else _PLACE
    places = np.stack([table.numbers(x), table.numbers(y), table.numbers(z, gaps=True)], 1)
    if geodetic:
        table.check(x, np.abs(places[:, 0]) <= 90, "a latitude is within 90 degrees")
        table.check(y, np.abs(places[:, 1]) <= 360, "a longitude is within 360 degrees")
    return MeasuredPositions(table.once("name"), places, table.sigmas(), geodetic)


def read_directions(path: Path | str) -> MeasuredDirections:
    """Which way is down in the frames of cameras; vectors of any length. Raises as `read_positions`."""
    table = _Table.read(path, ("name",), (_PLACE,), ("sigma_deg",))
    vectors = np.stack([table.numbers(name) for name in _PLACE], 1)
    lengths = np.linalg.norm(vectors, axis=1)
    table.check("x", lengths > 0, "a direction has a length")
    return MeasuredDirections(table.once("name"), vectors / lengths[:, None], table.positive("sigma_deg"))


def read_distances(path: Path | str) -> MeasuredDistances:
    """How far apart pairs of photos were taken. Raises as `read_positions`."""
    table = _Table.read(path, ("name1", "name2"), (("distance",),), ("sigma",))
    pairs = tuple(zip(table.texts("name1"), table.texts("name2"), strict=True))
    table.check("name2", np.array([one != two for one, two in pairs], bool), "a distance is between two photos")
    distances = table.numbers("distance")
    table.check("distance", distances >= 0, "a distance is not negative")
    return MeasuredDistances(pairs, distances, table.positive("sigma"))


def read_control_points(path: Path | str) -> ControlPoints:
    """Where points lie. Raises as `read_positions`."""
    table = _Table.read(path, ("point",), (_PLACE,), _SIGMAS)
    positions = np.stack([table.numbers("x"), table.numbers("y"), table.numbers("z", gaps=True)], 1)
    return ControlPoints(table.once("point"), positions, table.sigmas())


def read_marks(path: Path | str) -> Marks:
    """Where points are marked in photos; a point once in each. Raises as `read_positions`."""
    table = _Table.read(path, ("point", "name"), (("x", "y"),), ())
    labels, names = table.texts("point"), table.texts("name")
    table.check("point", _firsts(list(zip(labels, names, strict=True))), "it is marked twice in this photo")
    return Marks(tuple(labels), tuple(names), np.stack([table.numbers("x"), table.numbers("y")], 1))


def _firsts(items: Sequence[tuple[str, str]]) -> np.ndarray:
    """(k,) whether none of the items before is the same."""
    first = {item: k for k, item in reversed(list(enumerate(items)))}
    return np.array([first[item] == k for k, item in enumerate(items)], bool)


@dataclasses.dataclass(frozen=True, slots=True)
class _Table:
    """The cells by column, and the number of the line of each row."""

    path: Path
    columns: dict[str, list[str]]
    lines: list[int]

    @staticmethod
    def read(
        path: Path | str, keys: Sequence[str], groups: Sequence[Sequence[str]], sigmas: Sequence[str],
        may_lack: Sequence[str] = (),
    ) -> _Table:  # fmt: skip
        """The table with all `keys`, all columns of one of the `groups`, and any of the `sigmas`."""
        path = Path(path)
        with os_errors(path):
            data = path.read_bytes()
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise FormatError("is no text in UTF-8", path=path, remedy=_header(keys, groups[0])) from error
        numbered = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"]
        try:
            rows = [next(csv.reader([line], skipinitialspace=True)) for _, line in numbered]
        except csv.Error as error:
            raise FormatError(f"is no table: {error}", path=path, remedy=_header(keys, groups[0])) from error
        if not rows:
            raise FormatError("is empty", path=path, remedy=_header(keys, groups[0]))
        header = [cell.strip().lower() for cell in rows[0]]
        known = {*keys, *(name for group in groups for name in group), *sigmas}
        for name in header:
            if name not in known:
                close = difflib.get_close_matches(name, sorted(known), n=1)
                remedy = f"did you mean {close[0]!r}?" if close else _header(keys, groups[0])
                raise FormatError(f"has an unknown column {name!r}", path=path, remedy=remedy)
        if len(set(header)) < len(header):
            raise FormatError("names a column twice", path=path, remedy=_header(keys, groups[0]))
        present = [group for group in groups if set(group) & set(header)] or [groups[0]]
        needed = {*keys, *(name for group in present for name in group)} - set(may_lack)
        if len(present) > 1 or needed - set(header):
            lacking = ", ".join(sorted(needed - set(header))) or "nothing, but has two kinds of places"
            raise FormatError(f"lacks {lacking}", path=path, remedy=_header(keys, present[0]))
        for (number, _), row in zip(numbered[1:], rows[1:], strict=True):
            if len(row) != len(header):
                cause = f"line {number} has {len(row)} values for {len(header)} columns"
                raise FormatError(cause, path=path, remedy="names with commas need quotation marks")
        if len(rows) == 1:
            raise FormatError("has a header and no line below it", path=path)
        columns = {name: [row[k].strip() for row in rows[1:]] for k, name in enumerate(header)}
        return _Table(path, columns, [number for number, _ in numbered[1:]])

    def texts(self, column: str) -> list[str]:
        """The cells of a column."""
        return self.columns[column]

    def once(self, column: str) -> tuple[str, ...]:
        """The cells of a column, each of which must occur only once."""
        first: dict[str, int] = {}
        for number, text in zip(self.lines, self.columns[column], strict=True):
            if text in first:
                raise FormatError(f"lines {first[text]} and {number} are both of {text!r}", path=self.path)
            first[text] = number
        return tuple(self.columns[column])

    def numbers(self, column: str, *, gaps: bool = False) -> np.ndarray:
        """A column of finite numbers; NaN where a cell is empty or the column is not there, if there may be `gaps`."""
        out = np.full(len(self.lines), np.nan)
        for row, text in enumerate(self.columns.get(column, [""] * len(out))):
            if text or not gaps:
                out[row] = self._number(text, row, column)
        return out

    def positive(self, column: str) -> np.ndarray:
        """A column of positive numbers, NaN where it is empty."""
        values = self.numbers(column, gaps=True)
        self.check(column, ~(values <= 0), "a standard deviation is positive")
        return values

    def sigmas(self) -> np.ndarray:
        """(k, 3) of the columns sx, sy, sz."""
        return np.stack([self.positive(name) for name in _SIGMAS], 1)

    def check(self, column: str, right: np.ndarray, rule: str) -> None:
        """Raises a `FormatError` that names the first line which breaks the rule."""
        if not np.all(right):
            row = int(np.argmin(right))
            raise FormatError(
                f"line {self.lines[row]}: {column} is {self.columns[column][row]!r}; {rule}", path=self.path
            )

    def _number(self, text: str, row: int, column: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise FormatError(f"line {self.lines[row]}: {column} is no number: {text!r}", path=self.path)
        return value


def _header(keys: Sequence[str], group: Sequence[str]) -> str:
    return f"begin it with the names of the columns: {','.join([*keys, *group])}"

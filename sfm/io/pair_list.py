"""A user's list of the pairs of images that are to be compared."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from pathlib import Path

from sfm.core.errors import FormatError, InputError
from sfm.io.atomic import os_errors


def read_pair_list(path: Path | str, names: Collection[str]) -> list[tuple[str, str]]:
    """Pairs of `names` from a text file with two of them a line, separated by a tab or by spaces.

    Names may hold spaces, as long as only one way to divide the line gives two known names. Empty lines and those that
    begin with # are passed over. The order of the two does not matter and repetitions do no harm: pairs come back in
    the order of their first mention, with the names in that order.

    Raises:
        InputError: a name is none of `names`, or both are the same; it says the line and the nearest name.
        FormatError: the file is no text, a line is not two names, or no line is.
    """
    path, known = Path(path), set(names)
    with os_errors(path):
        data = path.read_bytes()
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FormatError("is no text in UTF-8", path=path, remedy="write two names of images a line") from error
    pairs: dict[frozenset[str], tuple[str, str]] = {}
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith("#"):
            pair = _pair(line.strip(), known, f"line {number}", path)
            pairs.setdefault(frozenset(pair), pair)
    if not pairs:
        raise FormatError("names no pair of images", path=path, remedy="write two names of images a line")
    return list(pairs.values())


def _pair(line: str, known: Collection[str], where: str, path: Path) -> tuple[str, str]:
    separator = "\t" if "\t" in line else None
    words = [word.strip() for word in line.split(separator)]
    if len(words) < 2:
        raise FormatError(f"{where} is not two names: {line!r}", path=path, remedy="separate them by a space or a tab")
    joint = separator or " "
    divisions = [(joint.join(words[:k]), joint.join(words[k:])) for k in range(1, len(words))]
    fitting = [pair for pair in divisions if pair[0] in known and pair[1] in known]
    if len(fitting) > 1:
        raise FormatError(
            f"{where} can be divided in two ways: {line!r}", path=path, remedy="put a tab between the names"
        )
    if not fitting:
        # Most likely meant is the division of which one name is known.
        name1, name2 = next((pair for pair in divisions if pair[0] in known or pair[1] in known), divisions[0])
        unknown = name2 if name1 in known else name1
        raise InputError(f"{where}: there is no image {unknown!r}", path=path, remedy=_nearest(unknown, known))
    if fitting[0][0] == fitting[0][1]:
        raise InputError(f"{where} pairs {fitting[0][0]!r} with itself", path=path)
    return fitting[0]


def _nearest(name: str, known: Collection[str]) -> str:
    close = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else "names are relative to the folder of the photos"

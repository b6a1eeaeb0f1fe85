from __future__ import annotations

from pathlib import Path

import pytest

from sfm.core.errors import FormatError, InputError
from sfm.io.pair_list import read_pair_list

NAMES = ("a.jpg", "b.jpg", "sub/c d.jpg", "e.jpg")


def listed(folder: Path, text: str | bytes) -> list[tuple[str, str]]:
    path = folder / "pairs.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pair_list(path, NAMES)


def test_pairs_are_two_names_a_line_once_each(tmp_path):
    text = "# mine\n\na.jpg b.jpg\r\n  b.jpg\ta.jpg \nsub/c d.jpg e.jpg\ne.jpg a.jpg\n"
    assert listed(tmp_path, text) == [("a.jpg", "b.jpg"), ("sub/c d.jpg", "e.jpg"), ("e.jpg", "a.jpg")]


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path):
    assert listed(tmp_path, "\ufeffa.jpg b.jpg") == [("a.jpg", "b.jpg")]


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        (
            "a.jpg b.jpg\na.jpg bb.jpg",
            InputError,
            "pairs.txt: line 2: there is no image 'bb.jpg' — did you mean 'b.jpg'?",
        ),
        ("sub/c d.jpeg\ta.jpg", InputError, "line 1: there is no image 'sub/c d.jpeg' — did you mean 'sub/c d.jpg'?"),
        ("x y", InputError, "names are relative to the folder"),
        ("a.jpg a.jpg", InputError, "line 1 pairs 'a.jpg' with itself"),
        ("a.jpg", FormatError, "line 1 is not two names"),
        ("# nothing\n", FormatError, "names no pair"),
        (b"\xff\xfe\x00", FormatError, "no text in UTF-8"),
    ],
)
def test_what_is_wrong_is_said_with_line_and_remedy(tmp_path, text, error, said):
    with pytest.raises(error) as caught:
        listed(tmp_path, text)
    assert said in str(caught.value)


def test_a_line_that_can_be_divided_in_two_ways_is_refused(tmp_path):
    (tmp_path / "pairs.txt").write_text("a b c")
    with pytest.raises(FormatError, match="two ways"):
        read_pair_list(tmp_path / "pairs.txt", ["a", "b c", "a b", "c"])


def test_a_missing_file_is_an_error_of_the_user(tmp_path):
    with pytest.raises(InputError):
        read_pair_list(tmp_path / "none.txt", NAMES)

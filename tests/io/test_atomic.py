from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from sfm.core.errors import InputError
from sfm.io.atomic import atomic_path, check_writable, replace_folders, write_bytes, write_folder, write_text


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    target = tmp_path / "a b" / "ä.txt"
    write_text(target, "first\n")
    write_text(target, "zweite – Zeile\n", sync=True)
    assert target.read_bytes().decode() == "zweite – Zeile\n"
    assert os.listdir(target.parent) == ["ä.txt"]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "x"
    write_bytes(target, b"old")

    def fail() -> None:
        with atomic_path(target) as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["x"]


def test_a_file_has_the_permissions_of_any_other(tmp_path: Path) -> None:
    write_bytes(tmp_path / "ours", b"")
    (tmp_path / "plain").touch()
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("exists", [False, True])
def test_a_folder_is_written_all_or_nothing(tmp_path: Path, exists: bool) -> None:
    def broken() -> Iterator[bytes]:
        yield b"half"
        raise ValueError("the data end here")

    folder = tmp_path / "model"
    if exists:
        write_folder(folder, {"a": [b"old"], "b": [b"old"]})
    with pytest.raises(ValueError, match="end here"):
        write_folder(folder, {"a": [b"new"], "b": broken()})
    if exists:
        assert sorted(os.listdir(folder)) == ["a", "b"]
        assert (folder / "a").read_bytes() == b"old"
    assert os.listdir(tmp_path) == (["model"] if exists else [])


def test_a_folder_keeps_what_is_not_superseded(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    write_folder(folder, {"a": [b"1", b"2"], "old": [b""], "mine": [b""]})
    write_folder(folder, {"a": [b"3"]}, obsolete=["old", "never there"])
    assert sorted(os.listdir(folder)) == ["a", "mine"]
    assert (folder / "a").read_bytes() == b"3"


def test_folders_are_exchanged_once_all_new_ones_are_there(tmp_path: Path) -> None:
    def make(count: int, text: str, staging: Path) -> None:
        for k in range(count):
            write_folder(staging / str(k), {"a": [text.encode()]})

    def contents() -> dict[str, str]:
        return {
            path.relative_to(tmp_path).as_posix(): path.read_text() for path in tmp_path.rglob("*") if path.is_file()
        }

    replace_folders(tmp_path, lambda staging: make(3, "first", staging), obsolete=[])
    (tmp_path / "notes").touch()
    (tmp_path / ".new.0123.tmp").mkdir()
    old = [tmp_path / str(k) for k in range(3)]
    with pytest.raises(ZeroDivisionError):
        replace_folders(tmp_path, lambda staging: make(1 // 0, "", staging), obsolete=old)
    assert contents() == {"0/a": "first", "1/a": "first", "2/a": "first", "notes": ""}
    replace_folders(tmp_path, lambda staging: make(2, "second", staging), obsolete=old)
    assert contents() == {"0/a": "second", "1/a": "second", "notes": ""}
    replace_folders(tmp_path, lambda staging: None, obsolete=old[:2])
    assert os.listdir(tmp_path) == ["notes"]


def test_what_stands_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for write in (lambda path: write_bytes(path, b""), lambda path: write_folder(path, {"a": [b""]})):
        with pytest.raises(InputError) as error:
            write(tmp_path / "file" / "x")
        assert str(tmp_path / "file") in str(error.value)
        assert error.value.remedy


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_read_only_folder_is_an_input_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        for write in (lambda: write_bytes(tmp_path / "x", b""), lambda: write_folder(tmp_path, {"x": [b""]})):
            with pytest.raises(InputError, match=r"permission denied.*check the permissions"):
                write()
    finally:
        tmp_path.chmod(0o700)


def test_where_files_can_be_written_nothing_is_left_of_the_question(tmp_path: Path) -> None:
    (tmp_path / "there.txt").write_text("kept")
    check_writable(tmp_path / "there.txt", None, tmp_path / "new" / "deeper" / "x.txt")
    assert os.listdir(tmp_path) == ["there.txt"]
    assert (tmp_path / "there.txt").read_text() == "kept"


def test_where_files_cannot_be_written_that_is_known_before(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path, said in (("file/x.txt", "not a directory"), ("folder", "is a folder")):
        with pytest.raises(InputError, match=said):
            check_writable(tmp_path / path)
    if os.path.isdir("/proc/self"):
        with pytest.raises(InputError, match=r"/proc/x\.toml"):
            check_writable(Path("/proc/x.toml"))

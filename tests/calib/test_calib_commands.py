from __future__ import annotations

import ast
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import calib
from calib.boards import charuco
from calib.cli import main
from calib.cli.detect import _overlay_names
from calib.cli.photos import detect_photos, detection_from_json, detection_json, detector_sources, find_photos
from calib.detect import Detection
from sfm.core.errors import ExitCode, InputError, Rejected


@pytest.fixture
def photos(tmp_path):
    """Two photos of a ChArUco board, one of nothing and one that is cut off."""
    folder = tmp_path / "photos"
    folder.mkdir()
    layout = cv2.aruco.CharucoBoard((6, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    drawn = layout.generateImage((360, 300), marginSize=30)
    for name, blur in (("a2.png", 0.8), ("a10.png", 1.2)):
        cv2.imwrite(str(folder / name), cv2.GaussianBlur(drawn, (0, 0), blur))
    cv2.imwrite(str(folder / "empty.png"), np.full((100, 100), 90, np.uint8))
    (folder / "torn.png").write_bytes((folder / "a2.png").read_bytes()[:400])
    return find_photos([folder])


BOARD = charuco(6, 5, 0.03, 0.022)


def same(a, b):
    return json.dumps(detection_json(a)) == json.dumps(detection_json(b))


def test_photos_are_judged_alike_with_any_number_of_threads_and_from_the_cache(photos, tmp_path):
    cache = tmp_path / "cache"
    alone = detect_photos(photos, BOARD, threads=1)
    fresh = detect_photos(photos, BOARD, threads=3, cache=cache)
    again = detect_photos(photos, BOARD, threads=2, cache=cache)
    assert list(alone) == ["a2.png", "a10.png", "empty.png", "torn.png"]
    assert [bool(seen) for seen in alone.values()] == [True, True, False, False]
    assert alone["torn.png"] == Rejected("unreadable", "is truncated")
    assert all(same(alone[name], fresh[name]) and same(alone[name], again[name]) for name in photos)
    assert len(list(cache.iterdir())) == 3


def test_the_cache_knows_content_and_not_names(photos, tmp_path):
    cache = tmp_path / "cache"
    first = detect_photos(photos, BOARD, cache=cache)["a2.png"]
    for kept in cache.iterdir():  # were it asked for anything but this content, it would not be there
        kept.touch()
    copy = tmp_path / "renamed.png"
    copy.write_bytes(photos["a2.png"].read_bytes())
    second = detect_photos({"renamed.png": copy}, BOARD, cache=cache)["renamed.png"]
    assert isinstance(first, Detection)
    assert isinstance(second, Detection)
    assert (second.name, len(list(cache.iterdir()))) == ("renamed.png", 3)
    np.testing.assert_array_equal(first.points2D, second.points2D)
    detect_photos({"renamed.png": copy}, charuco(6, 5, 0.031, 0.022), cache=cache)
    assert len(list(cache.iterdir())) == 4


def test_another_version_looks_anew(photos, tmp_path, monkeypatch):
    one = {"a2.png": photos["a2.png"]}
    detect_photos(one, BOARD, cache=tmp_path / "cache")
    monkeypatch.setattr(calib, "__version__", "99.0")
    detect_photos(one, BOARD, cache=tmp_path / "cache")
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_the_cache_depends_on_every_source_that_looks_at_a_photo():
    root, met, left = Path(calib.__file__).parents[1], set(), {"calib.detect", "sfm.io.images"}
    while left:
        name = left.pop()
        file = (root / name.replace(".", "/")).with_suffix(".py")
        if file in met or not file.is_file():
            continue
        met.add(file)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                left |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    only_types_and_errors = {root / "sfm" / name for name in ("core/arrays.py", "core/errors.py", "io/atomic.py")}
    assert len(met) > 10
    assert met - only_types_and_errors <= set(detector_sources())


def test_a_broken_cache_is_made_anew(photos, tmp_path):
    cache = tmp_path / "cache"
    first = detect_photos(photos, BOARD, cache=cache)
    for kept in cache.iterdir():
        kept.write_text('{"name": 3')
    assert same(first["a2.png"], detect_photos(photos, BOARD, cache=cache)["a2.png"])


def test_a_detection_reads_back_from_json(photos):
    for seen in detect_photos(photos, BOARD).values():
        assert same(seen, detection_from_json(json.loads(json.dumps(detection_json(seen)))))


def test_a_folder_without_images_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no image"):
        find_photos([tmp_path])


def test_a_board_is_drawn_and_found_by_the_commands(sfm, tmp_path, photos):
    made = sfm("board", "charuco", "--cols", 6, "--rows", 5, "--square", "30mm", "--marker", "22mm", "-o", "board.pdf",
               module="calib")  # fmt: skip
    assert (made.returncode, made.stderr) == (0, "")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    found = sfm("detect", "photos", "--board", "board.toml", "--no-cache", "--overlays", "seen", "-o", "corners.json",
                "--json", module="calib")  # fmt: skip
    assert found.returncode == 0, found.stderr
    summary = json.loads(found.stdout)
    assert summary["images"]["a2.png"]["corners"] == 20
    assert summary["images"]["torn.png"]["reason"] == "unreadable"
    assert len(json.loads((tmp_path / "corners.json").read_text())["images"]["a2.png"]["points2D"]) == 20
    assert cv2.imread(str(tmp_path / "seen" / "a2.png")) is not None


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["board", "charuco", "-o", "b.pdf"], 2, "needs --cols"),
        (["board", "chessboard:9x6:25mm", "-o", "b.png"], 2, ".pdf or .svg"),
        (["board", "chessboard:9x6:25mm", "--marker", "3mm", "-o", "b.pdf"], 2, "says it all"),
        (["board", "chessboard:50x60:25mm", "--paper", "a4", "-o", "b.pdf"], 2, "larger --paper"),
        (["detect", "nowhere", "--board", "chessboard:9x6:25mm"], 3, "no such folder"),
        (["detect", ".", "--board", "none.toml"], 3, "none.toml"),
        (["bord"], 2, "did you mean `calib board`"),
    ],
)
def test_a_mistake_is_told_in_one_line(sfm, words, code, said):
    result = sfm(*words, module="calib")
    assert result.returncode == code
    assert said in result.stderr
    assert result.stderr.count("\n") == 1


def test_what_is_drawn_never_lies_among_the_photos(photos, tmp_path, capsys):
    folder = str(tmp_path / "photos")
    for target in (folder, f"{folder}/drawn"):
        assert main(["detect", folder, "--board", BOARD.spec, "--no-cache", "--overlays", target]) == ExitCode.USAGE
        assert "lies among the photos" in capsys.readouterr().err
    assert set(find_photos([tmp_path / "photos"])) == set(photos)
    outside = str(tmp_path / "drawn")
    assert main(["detect", folder, "--board", BOARD.spec, "--no-cache", "--overlays", outside]) == ExitCode.OK
    assert (tmp_path / "drawn" / "a2.png").is_file()


def test_drawings_are_named_as_their_photos_and_none_twice():
    named = _overlay_names(["a.png", "b.jpg", "left/b.png", "c.d.tif", "e.jpg", "e.png"])
    assert list(named.values()) == ["a.png", "b.png", "left/b.png", "c.d.png", "e.jpg.png", "e.png.png"]


def test_corners_are_written_as_json_or_not_at_all(photos, tmp_path, capsys):
    words = ["detect", str(tmp_path / "photos"), "--board", BOARD.spec, "-o", str(tmp_path / "c.txt")]
    assert main(words) == ExitCode.USAGE
    assert "must end in .json" in capsys.readouterr().err

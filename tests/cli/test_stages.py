"""The commands of single stages as a user meets them, on cuts of one picture."""

from __future__ import annotations

import json

import pytest
from PIL import Image

from tests.cli.test_cli import assert_one_line
from tests.pictures import texture


@pytest.fixture
def photos(tmp_path):
    """Four overlapping cuts of one picture, and one of another."""
    (tmp_path / "photos").mkdir()
    picture = texture(1, (360, 560))
    for k, x in enumerate((0, 40, 80, 120)):
        Image.fromarray(picture[20:320, x : x + 400]).save(tmp_path / "photos" / f"{k}.png")
    Image.fromarray(texture(2, (300, 400))).save(tmp_path / "photos" / "other.png")
    return tmp_path / "photos"


def test_the_stages_go_one_after_the_other_through_a_workspace(sfm, photos, tmp_path):
    first = sfm("features", "photos", "-o", "ws", "--threads", "1", "--set", "features.max_features=700")
    assert first.returncode == 0, first.stderr
    assert "5 images, keypoints each: 700 to 700" in first.stdout
    results = {name: sfm(name, "ws") for name in ("pairs", "match", "verify")}
    assert {name: result.returncode for name, result in results.items()} == dict.fromkeys(results, 0)
    assert "10 of 10 pairs of 5 images" in results["pairs"].stdout
    assert "features.max_features = 700" in results["pairs"].stderr  # kept in sfm.toml
    assert "10 pairs, matches each" in results["match"].stdout
    assert "6 of 10 pairs verified" in results["verify"].stdout
    assert "images that hang together: 4 of 5" in results["verify"].stdout
    verified = json.loads(sfm("verify", "ws", "--json").stdout)
    assert sum(bool(pair["kind"]) for pair in verified["pairs"]) == 6
    assert verified["groups"] == [["0.png", "1.png", "2.png", "3.png"], ["other.png"]]
    again = sfm("features", "ws", "--json")
    assert "5 known already" in again.stderr
    assert json.loads(again.stdout)["keypoints"]["other.png"] == 700


def test_a_stage_on_what_is_no_workspace_is_one_line(sfm, photos):
    assert_one_line(sfm("pairs", "absent"), 3, "there is no such workspace.*sfm features IMAGES -o")
    assert_one_line(sfm("verify", "photos"), 3, "is no workspace, it holds no database.db")
    assert_one_line(sfm("features", "absent"), 3, "there is no such folder")
    assert_one_line(sfm("features", "photos", "-o", "photos/ws"), 2, "never written to")


def test_options_of_a_stage_are_checked_as_those_of_a_run(sfm, photos, tmp_path):
    assert_one_line(sfm("features", "photos", "-o", "ws", "--set", "features.max_featurs=9"), 2, "did you mean")
    assert_one_line(sfm("features", "photos", "-o", "ws", "--threads", "-1"), 2, "must not be negative")
    assert sfm("match").returncode == 2
    assert not (tmp_path / "ws").exists()


def test_a_locked_workspace_is_refused_by_a_stage(sfm, photos, tmp_path):
    assert sfm("features", "photos", "-o", "ws").returncode == 0
    (tmp_path / "ws" / ".lock").write_text(json.dumps({"pid": 1, "host": "elsewhere", "started": ""}))
    assert_one_line(sfm("match", "ws"), 7, "another run works in this workspace")
    assert_one_line(sfm("features", "ws", "-o", "other"), 2, "-o has no meaning")

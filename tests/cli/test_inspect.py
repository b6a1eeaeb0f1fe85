"""`sfm inspect` as a user meets it."""

from __future__ import annotations

import json

import cv2
from PIL import Image

from tests.cli.test_cli import assert_one_line
from tests.pictures import texture


def test_a_folder_is_inspected_for_people_and_for_programs(sfm, tmp_path):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(texture(k, (300, 400))).save(tmp_path / "photos" / f"{k}.png")
    Image.fromarray(cv2.GaussianBlur(texture(3, (300, 400)), (0, 0), 3)).save(tmp_path / "photos" / "soft.png")
    (tmp_path / "photos" / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    before = sorted(tmp_path.rglob("*"))
    told = sfm("inspect", "photos", "--threads", "2")
    assert told.returncode == 0, told.stderr
    (row,) = [line for line in told.stdout.splitlines() if line.startswith("soft.png")]
    assert "400×300" in row
    assert row.endswith("blurred")
    assert "broken.jpg: " in told.stdout
    assert "- 1 blurred (soft.png)" in told.stdout
    assert "4 photos, sharpness" in told.stdout
    numbers = json.loads(sfm("inspect", "photos", "--json").stdout)
    assert [image["focus"] for image in numbers["images"]] == ["sharp", "sharp", "sharp", "blurred"]
    assert set(numbers["unreadable"]) == {"broken.jpg"}
    assert sorted(tmp_path.rglob("*")) == before


def test_what_cannot_be_inspected_is_one_line(sfm, tmp_path):
    (tmp_path / "empty").mkdir()
    assert_one_line(sfm("inspect", "absent"), 3, "there is no such folder")
    assert_one_line(sfm("inspect", "empty"), 3, "there are no photos in this folder")
    assert_one_line(sfm("inspect", "empty", "--threads", "-1"), 2, "must not be negative")

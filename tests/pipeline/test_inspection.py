"""A folder of photos with every kind of fault is seen for what it is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm.core.errors import InputError
from sfm.core.events import ImageRead
from sfm.pipeline.inspection import inspect_folder
from tests.pictures import texture

SIZE = (300, 400)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for k in range(5):
        Image.fromarray(texture(k, SIZE)).save(folder / f"good{k}.png")
    Image.fromarray(cv2.GaussianBlur(texture(11, SIZE), (0, 0), 3)).save(folder / "blurred.png")
    Image.fromarray((texture(7, SIZE) * 0.2).astype(np.uint8)).save(folder / "night.png")
    Image.fromarray(np.full((*SIZE, 3), 120, np.uint8)).save(folder / "wall.png")
    shutil.copy(folder / "good1.png", folder / "same.png")
    (folder / "below").mkdir()
    Image.fromarray(texture(2, SIZE)).resize((200, 150)).save(folder / "below" / "small.jpg", quality=80)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Model 7", 6
    exif.get_ifd(0x8769).update({0xA405: 28, 0x9003: "2024:02:29 23:59:58"})
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 30.0, 0.0), 3: "E", 4: (8.0, 15.0, 0.0)})
    Image.fromarray(texture(9, SIZE)).save(folder / "told.jpg", exif=exif, quality=95)
    data = (folder / "told.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(data[: len(data) // 2])
    (folder / "notes.txt").write_text("no photo")
    (folder / "empty.png").write_bytes(b"")
    return folder


def test_each_photo_is_seen_for_what_it_is(folder):
    found = inspect_folder(folder, threads=2)
    focus = {image.name: found.focus(image) for image in found.images}
    assert {name for name, verdict in focus.items() if verdict == "blurred"} == {"blurred.png"}
    assert {name for name, verdict in focus.items() if verdict == "no detail"} == {"wall.png"}
    exposure = {image.name: image.exposure.verdict for image in found.images}
    assert {name: verdict for name, verdict in exposure.items() if verdict != "good"} == {
        "night.png": "dark",
        "wall.png": "flat",
    }
    assert found.copies == [["good1.png", "same.png"]]
    assert found.near_copies == [["below/small.jpg", "good2.png"]]
    assert set(found.unreadable) == {"cut.jpg", "notes.txt", "empty.png"}
    assert "truncated" in found.unreadable["cut.jpg"]


def test_what_exif_says_is_told(folder):
    (told,) = (image for image in inspect_folder(folder, threads=1).images if image.name == "told.jpg")
    assert (told.info.make, told.info.model, told.info.orientation) == ("Maker", "Model 7", 6)
    assert told.info.gps == pytest.approx((47.5, 8.25))
    assert told.focal_px == pytest.approx(28 * 500 / np.hypot(36, 24))


def test_the_advice_names_every_fault_and_nothing_else(folder, tmp_path):
    advice = "\n".join(inspect_folder(folder).advice())
    for word in ("1 blurred (blurred.png)", "hardly any detail (wall.png)", "1 dark", "1 exact copies", "1 near copies",
                 "2 sizes", "no focal length in EXIF for 10 of 11", "3 files cannot be used"):  # fmt: skip
        assert word in advice
    for k in range(3):
        shutil.copy(folder / f"good{k}.png", tmp_path)
    (line,) = inspect_folder(tmp_path).advice()
    assert (
        line
        == "no focal length in EXIF for 3 of 3: it is estimated; if one camera took all of them, say --single-camera"
    )
    (tmp_path / "good2.png").unlink()
    assert inspect_folder(tmp_path).advice()[0].startswith("three photos are the least")


def test_nothing_is_written_and_threads_do_not_matter(folder):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    one, many = (json.dumps(inspect_folder(folder, threads=threads).to_json()) for threads in (1, 4))
    assert one == many
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_every_file_is_told_as_it_is_read(folder):
    events = []
    inspect_folder(folder, threads=1, observer=events.append)
    read = {event.name: event.reason for event in events if isinstance(event, ImageRead)}
    assert len(read) == 12  # the photos, and the one that is cut
    assert [name for name, reason in read.items() if reason] == ["cut.jpg"]


def test_a_folder_without_photos_is_refused_or_said_to_have_none(tmp_path):
    with pytest.raises(InputError, match="no photos in this folder"):
        inspect_folder(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        inspect_folder(tmp_path / "absent")
    (tmp_path / "notes.txt").write_text("no photo")
    found = inspect_folder(tmp_path)
    assert (list(found.images), found.advice()) == ([], ["none of these files is a usable photo"])
    assert found.to_json()["median_sharpness"] is None

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.core.errors import ImageError, InputError
from sfm.io.masks import check_mask_size, find_masks, masked_share, masks_folder, photos_among, read_mask


def picture(path: Path, shape: tuple[int, ...] = (20, 30), value: int = 255) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(shape, value, np.uint8))
    return path


@pytest.mark.parametrize(
    "mask",
    ["IMG.jpg.png", "IMG.png", "IMG_mask.png", "IMG-mask.jpg", "IMG.mask.png", "mask_IMG.png", "img.JPG.png",
     "mask-IMG.png", "IMG.jpg_mask.png"],
)  # fmt: skip
@pytest.mark.parametrize("sub", ["", "left/day 1/"])
def test_masks_are_found_by_their_usual_names(tmp_path, mask, sub):
    picture(tmp_path / "masks" / f"{sub}{mask}")
    found = find_masks([f"{sub}IMG.jpg", f"{sub}IMG2.jpg"], tmp_path / "photos", tmp_path / "masks")
    assert found == {f"{sub}IMG.jpg": tmp_path / "masks" / f"{sub}{mask}"}


def test_a_mask_in_no_sub_folder_serves_where_the_name_is_unique(tmp_path):
    picture(tmp_path / "masks" / "a.png")
    picture(tmp_path / "masks" / "b.png")
    found = find_masks(["left/a.jpg", "left/b.jpg", "right/b.jpg"], tmp_path / "photos", tmp_path / "masks")
    assert found == {"left/a.jpg": tmp_path / "masks" / "a.png"}


def test_a_mask_may_be_called_as_its_photo(tmp_path):
    picture(tmp_path / "masks" / "a.png")
    assert find_masks(["a.png"], tmp_path / "photos", tmp_path / "masks") == {"a.png": tmp_path / "masks" / "a.png"}


def test_the_most_telling_name_wins(tmp_path):
    for name in ("a.png", "a.jpg.png", "a_mask.png"):
        picture(tmp_path / "masks" / name)
    assert find_masks(["a.jpg"], tmp_path, tmp_path / "masks") == {"a.jpg": tmp_path / "masks" / "a.jpg.png"}


def test_a_folder_without_any_mask_of_a_photo_is_an_error_with_the_expected_names(tmp_path):
    picture(tmp_path / "masks" / "other.png")
    with pytest.raises(InputError, match=r"no file here") as error:
        find_masks(["sub/IMG 1.jpg"], tmp_path / "photos", tmp_path / "masks")
    assert "IMG 1.jpg.png, IMG 1.png, IMG 1_mask.png or mask_IMG 1.png" in str(error.value)
    assert str(tmp_path / "masks") in str(error.value)


def test_the_folder_is_named_or_within_or_beside(tmp_path):
    photos = tmp_path / "photos"
    picture(photos / "a.png")
    assert masks_folder(photos, "") is None
    (tmp_path / "masks").mkdir()
    assert masks_folder(photos, "") == tmp_path / "masks"
    (photos / "masks").mkdir()
    assert masks_folder(photos, "") == photos / "masks"
    (tmp_path / "elsewhere").mkdir()
    assert masks_folder(photos, str(tmp_path / "elsewhere")) == tmp_path / "elsewhere"
    assert masks_folder(photos, "none") is None
    assert masks_folder(tmp_path / "masks", "") is None  # photos in a folder called masks are no masks
    with pytest.raises(InputError, match="no such folder of masks"):
        masks_folder(photos, str(tmp_path / "nowhere"))


def test_masks_within_the_photos_are_no_photos(tmp_path):
    names = ("a.jpg", "masks/a.png", "masksof/b.jpg")
    (tmp_path / "masks").mkdir()
    assert photos_among(names, tmp_path, tmp_path / "masks") == ("a.jpg", "masksof/b.jpg")
    assert photos_among(names, tmp_path, None) == names
    assert photos_among(names, tmp_path, tmp_path.parent) == names


def test_a_link_to_masks_within_the_photos_holds_no_photos(tmp_path):
    images, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    images.mkdir()
    elsewhere.mkdir()
    (images / "masks").symlink_to(elsewhere)
    assert photos_among(["a.jpg", "masks/a.png"], images, images / "masks") == ("a.jpg",)


def test_masks_beside_their_photos_are_told_by_their_name(tmp_path):
    names = ("a.jpg", "a.png", "a_mask.png", "b.jpg", "b.jpg.png", "c_mask.jpg")
    assert photos_among(names, tmp_path, tmp_path) == ("a.jpg", "a.png", "b.jpg", "c_mask.jpg")
    found = find_masks(names, tmp_path, tmp_path)
    assert found["a.jpg"] == tmp_path / "a_mask.png"
    assert found["b.jpg"] == tmp_path / "b.jpg.png"
    assert "c_mask.jpg" not in found


def test_a_mask_of_another_size_is_an_error_that_names_both(tmp_path):
    path = picture(tmp_path / "a.png", (20, 30))
    check_mask_size(path, "sub/a.jpg", 30, 20)
    with pytest.raises(ImageError, match=r"30×20 px, its photo sub/a\.jpg has 60×40 px"):
        check_mask_size(path, "sub/a.jpg", 60, 40)
    with pytest.raises(ImageError, match="EXIF"):
        check_mask_size(path, "sub/a.jpg", 20, 30)


def test_black_is_hidden_and_all_else_is_kept(tmp_path):
    values = np.array([[0, 1, 255, 128]], np.uint8).repeat(20, axis=0).repeat(8, axis=1)
    cv2.imwrite(str(tmp_path / "grey.png"), values)
    np.testing.assert_array_equal(read_mask(tmp_path / "grey.png"), values > 0)
    assert masked_share(read_mask(tmp_path / "grey.png")) == 0.25


def test_a_lossy_mask_is_cut_in_the_middle(tmp_path):
    values = np.zeros((64, 64), np.uint8)
    values[:, 29:] = 255
    cv2.imwrite(str(tmp_path / "mask.jpg"), values, [cv2.IMWRITE_JPEG_QUALITY, 60])
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.jpg"), values > 0)

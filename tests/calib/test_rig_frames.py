"""Which photos belong together, by their names."""

from __future__ import annotations

import pytest

from calib.rig_frames import FrameTable, Pairing, pair_photos
from sfm.core.errors import Rejected


def paired(photos, by: Pairing = "auto") -> FrameTable:
    table = pair_photos(photos, by)
    assert not isinstance(table, Rejected), table
    return table


@pytest.mark.parametrize(
    ("left", "right", "by", "shared"),
    [
        (["1.png", "2.png", "10.png"], ["1.jpg", "2.jpg", "10.jpg"], "stem", ("1", "10", "2")),
        (["left01.jpg", "left11.jpg"], ["right1.jpg", "right11.jpg"], "number", ("01", "11")),
        (["7_cam1.png", "8_cam1.png"], ["7_cam2.png", "8_cam2.png"], "number", ("7", "8")),
        (["cam1/a3.png", "cam1/a4.png"], ["cam2/b4.png", "cam2/b5.png"], "number", ("4",)),
        (["s1_f1.png", "s1_f2.png", "s2_f1.png"], ["r1_f1.png", "r2_f2.png", "r2_f1.png"], "number", ("1-1", "2-1")),
        (["night.png"], ["night.tif", "day.tif"], "stem", ("night",)),
    ],
)  # fmt: skip
def test_photos_are_paired_by_what_their_names_share(left, right, by, shared):
    table = paired({"a": left, "b": right})
    assert (table.by, table.shared) == (by, shared)


def test_photos_without_a_partner_are_known():
    table = paired({"a": ["1.png", "2.png", "3.png"], "b": ["2.png", "3.png"], "c": ["3.png", "9.png"]})
    assert table.without_partner("a") == ("1.png",)
    assert table.without_partner("c") == ("9.png",)
    assert table.shared == ("2", "3")


def test_what_pairs_more_photos_is_taken():
    table = paired({"a": ["a1.png", "a2.png", "x.png"], "b": ["b1.png", "b2.png", "x.png"]})
    assert table.by == "number"
    assert table.shared == ("1", "2", "x")


def test_order_pairs_only_as_many_and_only_if_asked():
    assert paired({"a": ["p", "q"], "b": ["r", "s"]}, "order").shared == ("0", "1")
    reason = pair_photos({"a": ["p", "q"], "b": ["r"]}, "order")
    assert isinstance(reason, Rejected)
    assert (reason.reason, reason.detail[-8:]) == ("different_counts", "a 2, b 1")


def test_names_that_do_not_agree_are_refused():
    reason = pair_photos({"a": ["1700000001.png", "1700000035.png"], "b": ["1700000007.png"]})
    assert isinstance(reason, Rejected)
    assert reason.reason == "no_common_frame"


def test_two_photos_of_one_frame_are_refused():
    reason = pair_photos({"a": ["l1.png", "l01.png"], "b": ["r1.png", "r2.png"]}, "number")
    assert isinstance(reason, Rejected)
    assert (reason.reason, reason.detail) == ("two_photos_of_a_frame", "a: l1.png and l01.png are both frame 1")

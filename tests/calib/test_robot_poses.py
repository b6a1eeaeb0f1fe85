"""Which row of a robot's table belongs to which photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.cli.robot_poses import poses_of_photos
from calib.refine_views import BoardView
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

TABLE = Path("robot.csv")


def views_of(*names):
    return [BoardView(name, 640, 480, np.arange(2), np.ones((2, 2))) for name in names]


def table_of(*names):
    """The k-th row has the place (k, 0, 0)."""
    return {name: Rigid3(Rotation3.identity(), np.array([float(k), 0, 0])) for k, name in enumerate(names)}


@pytest.mark.parametrize(
    ("photos", "rows", "places"),
    [
        (["a.png", "b.png"], ["b.png", "a.png"], [1, 0]),
        (["left/a.png", "left/b.jpg"], ["a", "b.png"], [0, 1]),
        (["a.jpg"], ["left/a.png"], [0]),
        (["left/a.png", "right/a.png"], ["right/a.png", "left/a.png"], [1, 0]),
        (["left/a.png", "right/a.jpg"], ["left/a.png", "right/a.png"], [0, 1]),
        (["0.1.png", "0.2.png"], ["0.1", "0.2"], [0, 1]),
        (["a.png", "other/a.png"], ["a.png"], [0]),
        (["b.jpg"], ["a/1.png", "b/1.png", "b.png"], [2]),
    ],
)
def test_a_photo_has_the_pose_that_is_called_like_it(photos, rows, places):
    kept, poses, alone = poses_of_photos(views_of(*photos), table_of(*rows), TABLE)
    np.testing.assert_array_equal(poses.translation[:, 0], places)
    assert [view.name for view in kept] == photos[: len(places)]
    assert [view.name for view in alone] == photos[len(places) :]


@pytest.mark.parametrize(
    ("photos", "rows", "told"),
    [
        (
            ["left01.jpg"],
            ["left/left01.png", "right/left01.png"],
            "left01.jpg may be left/left01.png or right/left01.png",
        ),
        (["left/01.png", "right/01.png"], ["01"], "01 in the table may be the photo left/01.png or right/01.png"),
        (["a.png", "a.jpg"], ["a"], "a in the table may be the photo a.png or a.jpg"),
    ],
)
def test_what_may_be_either_of_two_is_refused(photos, rows, told):
    with pytest.raises(FormatError, match=told):
        poses_of_photos(views_of(*photos), table_of(*rows), TABLE)


def test_a_table_of_other_photos_is_refused():
    with pytest.raises(FormatError, match="names no photo"):
        poses_of_photos(views_of("a.png"), table_of("b.png"), TABLE)

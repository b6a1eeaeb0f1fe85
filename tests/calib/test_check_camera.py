from __future__ import annotations

import dataclasses

from calib.check import CameraCheck, check_camera, known_shape
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen


def test_copies_of_a_photo_are_checked_once_and_named(rng):
    views = seen(LENS, flat_board(), poses_before(LENS, 6, rng), rng)
    copies = [dataclasses.replace(views[2], name=f"copy{k}") for k in range(3)]
    shape = known_shape(flat_board())
    plain, found = (check_camera(LENS, shape, some, limit_px=1.0) for some in (views, [*views, *copies]))
    assert isinstance(plain, CameraCheck)
    assert isinstance(found, CameraCheck)
    assert found.rms_px == plain.rms_px
    assert [(view.name, view.reason) for view in found.left_out] == [(f"copy{k}", "copy_of view02") for k in range(3)]

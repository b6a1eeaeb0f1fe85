from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.io.camera_files import read_camera_file, read_intrinsics, write_camera_toml
from sfm.io.camera_records import BoardRecord, CameraRecord, ParameterCovariance

CAMERA = Camera("OPENCV", 640, 480, np.array([500.0, 501, 320, 240, 0.1, 0, 0, 0]))
HEAD = '[camera]\nmodel = "PINHOLE"\nwidth = 9\nheight = 9\nparams = [1, 1, 1, 1]\n'


def record(rng: np.random.Generator) -> CameraRecord:
    root = rng.normal(size=(3, 3))
    return CameraRecord(
        {"command": 'calib "x" \\', "photos": 3, "rms_px": 0.1, "converged": False},
        ParameterCovariance(("fx", "cx", "k1"), root @ root.T, rng.uniform(size=3)),
        BoardRecord("chessboard:9x6:25mm", "free", rng.normal(size=(54, 3))),
        (("few_views", "3 views\nof – “a” board", "take more"),),
    )


def test_a_record_reads_back_to_the_last_bit(tmp_path, rng):
    written = record(rng)
    write_camera_toml(tmp_path / "c.toml", CAMERA, name="left", record=written)
    camera, again = read_camera_file(tmp_path / "c.toml")
    assert camera.params.tolist() == CAMERA.params.tolist()
    assert dict(again.facts) == dict(written.facts)
    assert again.findings == written.findings
    assert again.uncertainty is not None
    assert written.uncertainty is not None
    assert again.board is not None
    assert written.board is not None
    assert again.uncertainty.free == ("fx", "cx", "k1")
    np.testing.assert_array_equal(again.uncertainty.covariance, written.uncertainty.covariance)
    np.testing.assert_array_equal(again.uncertainty.sigma_by_view, written.uncertainty.sigma_by_view)
    assert (again.board.spec, again.board.shape) == (written.board.spec, written.board.shape)
    np.testing.assert_array_equal(again.board.displacements, written.board.displacements)


def test_intrinsics_are_those_of_the_camera_whatever_else_is_there(tmp_path, rng):
    write_camera_toml(tmp_path / "c.toml", CAMERA, record=record(rng))
    assert read_intrinsics(tmp_path / "c.toml")[1].params.tolist() == CAMERA.params.tolist()


def test_a_file_without_a_record_has_an_empty_one(tmp_path):
    write_camera_toml(tmp_path / "c.toml", CAMERA)
    _, nothing = read_camera_file(tmp_path / "c.toml")
    assert not nothing.facts
    assert nothing.uncertainty is None
    assert nothing.board is None
    assert np.isnan(nothing.number("rms_px"))


@pytest.mark.parametrize(
    ("tables", "cause"),
    [
        ("[calibration]\nrsm_px = 1.0", "unknown key 'rsm_px'"),
        ('[calibration]\nphotos = "three"', "photos must be int"),
        ("[calibration]\nconverged = 1", "converged must be bool"),
        ('[uncertainty]\nfree = ["k1"]\ncovariance = [[1.0]]', "must name parameters of PINHOLE"),
        ('[uncertainty]\nfree = ["cx", "fx"]\ncovariance = [[1.0, 0.0], [0.0, 1.0]]', "in order"),
        ('[uncertainty]\nfree = ["fx", "cx"]\ncovariance = [[1.0, 0.0]]', "2 × 2 finite numbers"),
        ('[uncertainty]\nfree = ["fx", "cx"]\ncovariance = [[1.0, 0.5], [0.0, 1.0]]', "symmetric"),
        ('[uncertainty]\nfree = ["fx"]\ncovariance = [[-1.0]]', "negative"),
        ('[uncertainty]\nfree = ["fx"]\ncovariance = [[1.0]]\nsigma_by_view = [1.0, 2.0]', "sigma_by_view must be"),
        ('[board]\nspec = "chessboard:9x6:25mm"', "needs shape"),
        ('[board]\nspec = "b"\nshape = "free"\ndisplacements = [[1.0, 2.0]]', "1 × 3 finite numbers"),
        ('[[finding]]\ncause = "x"', "needs cause, detail and remedy"),
        ("finding = 3", "finding"),
        ("calibration = 3", "must be a table"),
    ],
)
def test_a_wrong_table_is_named(tmp_path, tables, cause):
    body = f"{tables}\n{HEAD}" if not tables.startswith("[") else f"{HEAD}{tables}\n"
    (tmp_path / "c.toml").write_text(body)
    with pytest.raises(FormatError, match=cause.replace("[", r"\[")):
        read_camera_file(tmp_path / "c.toml")

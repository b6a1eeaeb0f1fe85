"""The other commands on the workspace of a real run."""

from __future__ import annotations

import json

import pytest

pytestmark = pytest.mark.slow


def test_a_finished_workspace_agrees_with_the_truth(sfm, rendered, finished):
    truth = rendered("facade") / "truth"
    result = sfm("compare", finished, truth / "sparse" / "0", "--json")
    assert result.returncode == 0, result.stderr
    numbers = json.loads(result.stdout)
    assert (numbers["images"]["registered"], numbers["images"]["reference"]) == (5, 9)
    assert 1e-4 < numbers["rotation_error_deg"]["max"] < 0.5  # five photos of an unknown camera
    assert 0.95 < numbers["relative_pose"]["auc_deg_registered"]["10"] < 1
    assert "5 of 9 images" in sfm("compare", finished, truth / "sparse" / "0").stdout


def test_a_model_survives_the_way_through_text(sfm, finished, tmp_path):
    for source, target in ((finished, "text"), ("text", "binary")):
        result = sfm("convert", source, target)
        assert result.returncode == 0, result.stderr
    files = sorted(path.name for path in (tmp_path / "binary").iterdir())
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= set(files)
    for name in files:
        assert (tmp_path / "binary" / name).read_bytes() == (finished / "sparse" / "0" / name).read_bytes(), name


def test_the_points_become_a_cloud(sfm, finished, tmp_path):
    result = sfm("convert", finished, "cloud.ply")
    assert result.returncode == 0, result.stderr
    head = (tmp_path / "cloud.ply").read_bytes()[:500]
    points = json.loads((finished / "manifest.json").read_text())["models"][0]["points"]
    assert f"element vertex {points}\n".encode() in head


def test_a_scene_is_saved_with_its_photos(sfm, finished, tmp_path):
    pytest.importorskip("rerun")
    result = sfm("view", finished, "--save", "scene.rrd")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "scene.rrd"
    assert "photo" not in result.stderr
    assert (tmp_path / "scene.rrd").stat().st_size > 100_000

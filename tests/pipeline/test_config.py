from __future__ import annotations

import pytest

from sfm.core.errors import ConfigError
from sfm.features import FeatureConfig
from sfm.pipeline.config import (
    CameraConfig,
    PipelineConfig,
    flattened,
    parsed_setting,
    read_toml,
    to_toml,
    with_settings,
)


def test_toml_gives_back_what_was_written(tmp_path):
    config = PipelineConfig(
        cameras=CameraConfig(model="OPENCV", sharing="folder", intrinsics='a "quoted" näme\\.txt'),
        features=FeatureConfig(max_image_size=800, contrast_threshold=0.01),
        seed=7,
    )
    path = tmp_path / "sfm.toml"
    path.write_text(to_toml(config), encoding="utf-8")
    assert dict(flattened(read_toml(path, PipelineConfig()))) == dict(flattened(config))


def test_what_a_file_does_not_name_stays(tmp_path):
    path = tmp_path / "sfm.toml"
    path.write_text("[features]\nmax_features = 100\n[verification.ransac]\nmax_error_px = 2\n")
    config = read_toml(path, PipelineConfig(seed=3))
    assert (config.seed, config.features.max_features, config.verification.ransac.max_error_px) == (3, 100, 2.0)
    assert isinstance(config.verification.ransac.max_error_px, float)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("features.max_featurs", 5, "did you mean features.max_features"),
        ("max_features", 5, "did you mean features.max_features"),
        ("features.max_features", 5.5, "must be int, got 5.5"),
        ("features.max_features", True, "must be int, got True"),
        ("features.max_features", 0, "must be at least 1"),
        ("cameras.sharing", "all", "auto | single | folder | image"),
        ("cameras.model", "OPENVC", "did you mean OPENCV"),
        ("seed", -1, "must not be negative"),
        ("features", 1, "unknown setting 'features'"),
    ],
)
def test_a_wrong_setting_is_refused_with_source_and_hint(key, value, message):
    with pytest.raises(ConfigError) as caught:
        with_settings(PipelineConfig(), {key: value}, "the source")
    assert message in str(caught.value)
    assert "the source" in str(caught.value)


def test_a_file_that_is_no_toml_is_refused(tmp_path):
    path = tmp_path / "sfm.toml"
    path.write_text("seed: 1")
    with pytest.raises(ConfigError, match="cannot be read as TOML"):
        read_toml(path, PipelineConfig())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.b=3", ("a.b", 3)),
        ("a=0.5", ("a", 0.5)),
        ("a = true", ("a", True)),
        ("a=OPENCV", ("a", "OPENCV")),
        ('a="x=y"', ("a", "x=y")),
        ("a=", ("a", "")),
    ],
)
def test_settings_of_the_command_line_are_toml_or_bare_words(text, expected):
    assert parsed_setting(text) == expected


def test_a_setting_without_a_value_is_refused():
    with pytest.raises(ConfigError, match="KEY=VALUE"):
        parsed_setting("features.max_features")

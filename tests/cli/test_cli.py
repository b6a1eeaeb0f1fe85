"""The commands as a user meets them: as processes, with what they print and the code they return."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from sfm import cli
from tests.pictures import texture

ROOT = Path(__file__).resolve().parents[2]


def errors(result: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in result.stderr.splitlines() if line.startswith("error: ")]


def assert_one_line(result: subprocess.CompletedProcess[str], code: int, pattern: str) -> None:
    assert result.returncode == code, result.stderr
    (line,) = errors(result)
    assert re.search(pattern, line)
    assert "Traceback" not in result.stderr + result.stdout


def test_the_table_of_commands_needs_no_heavy_module():
    script = (
        "import sys; from sfm.cli import main; code = main(['--help'])\n"
        "heavy = {'numpy', 'numba', 'cv2', 'tyro', 'rich', 'jaxtyping', 'pycolmap', 'PIL'} & set(sys.modules)\n"
        "assert not heavy, heavy\nsys.exit(code)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert result.returncode == 0, result.stderr
    assert [name for name in cli.COMMANDS if f"  {name} " not in result.stdout] == []


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["--version"]])
@pytest.mark.parametrize("module", ["sfm", "calib", "stereo"])
def test_help_and_version_are_results(sfm, module, words):
    result = sfm(*words, module=module)
    assert (result.returncode, result.stderr) == (0, "")
    assert "Parallax" in result.stdout


@pytest.mark.parametrize("module", ["stereo"])
def test_commands_that_do_not_exist_yet_say_so(sfm, module):
    assert_one_line(sfm("camera", module=module), 2, "no commands yet")
    assert "nothing here yet" in sfm("--help", module=module).stdout


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_every_command_has_help_with_an_example(sfm, command):
    result = sfm(command, "--help")
    assert result.returncode == 0
    assert f"  sfm {command}" in result.stdout.partition("Examples:")[2]


def test_an_unknown_command_is_answered_with_the_nearest(sfm):
    assert_one_line(sfm("rnu", "photos"), 2, "did you mean `sfm run`")


def test_no_command_is_a_mistake_of_usage(sfm):
    result = sfm()
    assert result.returncode == 2
    assert "Usage" in result.stdout


def test_an_unknown_flag_is_answered_with_the_nearest(sfm):
    result = sfm("run", "photos", "--max-imagesize", "100")
    assert result.returncode == 2
    assert "--max-image-size" in result.stderr + result.stdout


@pytest.mark.parametrize(
    ("words", "pattern"),
    [
        (["--camera-model", "openvc"], "did you mean OPENCV"),
        (["--single-camera", "--camera-per-image"], "exclude each other"),
        (["--set", "features.max_featurs=9"], "did you mean features.max_features"),
        (["--max-image-size", "-5"], "max_image_size must be"),
        (["--threads", "-1"], "--threads must not be negative"),
        (["--pairs", "guess"], r"retrieval\.method must be auto \| exhaustive \| .*, got 'guess'"),
        (["--pairs", "look", "--pair-list", "pairs.txt"], "--pairs and --pair-list exclude each other"),
    ],
)
def test_a_wrong_value_is_a_mistake_of_usage(sfm, tmp_path, words, pattern):
    (tmp_path / "photos").mkdir()
    assert_one_line(sfm("run", "photos", "-o", "ws", *words), 2, pattern)


def test_a_missing_an_empty_and_a_wrong_folder_are_bad_input(sfm, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.jpg").write_bytes(b"x")
    assert_one_line(sfm("run", "absent"), 3, "absent: there is no such folder")
    assert_one_line(sfm("run", "empty"), 3, "empty: there are no photos in this folder")
    assert_one_line(sfm("run", "file.jpg"), 3, "is a file")
    assert not (tmp_path / "absent-sfm").exists()


def test_two_unrelated_photos_fail_with_one_line(sfm, tmp_path):
    (tmp_path / "photos").mkdir()
    for k in (1, 2):
        Image.fromarray(texture(k)).save(tmp_path / "photos" / f"{k}.png")
    assert_one_line(sfm("run", "photos"), 4, r"no two of 2 photos show the same scene.*1\.png and 2\.png.*overlap")
    assert (tmp_path / "photos-sfm" / "database.db").exists()
    assert sorted(path.name for path in (tmp_path / "photos").iterdir()) == ["1.png", "2.png"]


def test_a_locked_workspace_is_refused(sfm, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "ws").mkdir()
    Image.fromarray(texture(1)).save(tmp_path / "photos" / "1.png")
    (tmp_path / "ws" / ".lock").write_text(json.dumps({"pid": 1, "host": "elsewhere", "started": ""}))
    assert_one_line(sfm("run", "photos", "-o", "ws"), 7, "another run works in this workspace")


def test_a_workspace_within_the_photos_is_refused(sfm, tmp_path):
    (tmp_path / "photos").mkdir()
    assert_one_line(sfm("run", "photos", "-o", "photos/ws"), 2, "never written to")


def test_settings_of_the_workspace_hold_until_the_command_line_says_otherwise(sfm, tmp_path):
    (tmp_path / "photos").mkdir()
    Image.fromarray(texture(1)).save(tmp_path / "photos" / "1.png")

    def features(*words: str) -> str:
        result = sfm("run", "photos", "-o", "ws", *words)
        assert_one_line(result, 4, "one photo is not enough")
        return re.search(r"max_features = (\d+)", (tmp_path / "ws" / "sfm.toml").read_text())[1] + result.stderr

    assert features("--set", "features.max_features=50").startswith("50")
    again = features()
    assert again.startswith("50")
    assert "features.max_features = 50" in again
    assert features("--set", "features.max_features=60").startswith("60")
    (tmp_path / "ws" / "sfm.toml").write_text("[featurs]\nmax_features = 70\n")
    assert_one_line(sfm("run", "photos", "-o", "ws"), 2, r"sfm\.toml: unknown setting.*did you mean features")


@pytest.mark.skipif(os.name == "nt", reason="SIGINT is POSIX")
def test_an_interrupted_run_says_how_to_go_on(environment, tmp_path):
    (tmp_path / "photos").mkdir()
    for k in range(12):
        Image.fromarray(texture(k, (600, 800))).save(tmp_path / "photos" / f"{k}.png")
    command = [sys.executable, "-m", "sfm", "run", "photos", "-o", "ws", "--threads", "1"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells have it ignored in the background
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("features: 12 to do"):
                break
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert "interrupted: what was found is kept; to go on from there, repeat: sfm run photos -o ws --threads 1" in rest
    assert "Traceback" not in rest
    assert not (tmp_path / "ws" / ".lock").exists()


def test_a_bug_is_one_line_and_a_log(tmp_path, monkeypatch, capsys):
    def broken(words):
        raise RuntimeError("planted\nsecond line")

    monkeypatch.setattr("sfm.cli.doctor.main", broken)
    assert cli.main(["doctor"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == "error: this is a bug in Parallax: RuntimeError: planted second line"
    log = Path(second.removeprefix("log: "))
    assert "Traceback" in log.read_text()
    log.unlink()


def test_doctor_finds_what_is_needed(sfm):
    result = sfm("doctor")
    assert result.returncode == 0, result.stderr
    for word in ("cores", "memory", "kernels", "numpy", "pycolmap", "rerun-sdk"):
        assert word in result.stdout


def test_doctor_returns_6_if_something_needed_is_missing(monkeypatch, capsys):
    from sfm.cli import doctor

    absent = doctor._Package("no_such_module", ("no-such-distribution",))
    optional = doctor._Package("other_module", ("other-distribution",), "dreams", "dream")
    monkeypatch.setattr(doctor, "_PACKAGES", (absent, optional))
    assert doctor.main([]) == 6
    told = capsys.readouterr()
    assert "missing: no-such-distribution" in told.err
    assert "pip install 'parallax[dream]'" in told.out


@pytest.fixture
def model_folder(tmp_path: Path) -> Path:
    """A text model of three images."""
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    poses = ((0, 0), (1, 0), (2, 0.5))
    rows = [f"{k} 1 0 0 0 {x} {y} 0 1 image{k}.png\n\n" for k, (x, y) in enumerate(poses, start=1)]
    (folder / "images.txt").write_text("".join(rows))
    (folder / "points3D.txt").write_text("1 0 0 5 10 20 30 0.5\n")
    return folder


def test_a_model_agrees_with_itself(sfm, model_folder):
    result = sfm("compare", model_folder, model_folder)
    assert result.returncode == 0, result.stderr
    assert "3 of 3 images" in result.stdout
    assert "100.0 at 1°" in result.stdout
    numbers = json.loads(sfm("compare", model_folder, model_folder, "--json").stdout)
    assert numbers["images"]["registered"] == 3


def test_a_model_is_converted_there_and_back(sfm, model_folder, tmp_path):
    for words in (["model", "binary"], ["binary", "text"], ["text", "points.ply"]):
        result = sfm("convert", *words)
        assert result.returncode == 0, result.stderr
        assert words[1] in result.stdout
    assert (tmp_path / "binary" / "images.bin").exists()
    assert (tmp_path / "text" / "images.txt").exists()
    assert_one_line(sfm("convert", "model", "points.ply"), 3, "is there already")
    assert_one_line(sfm("compare", "model", "absent"), 3, "no such folder")


def test_the_workspace_of_a_scene_with_no_photos_left_can_still_be_looked_at(sfm, model_folder, tmp_path):
    pytest.importorskip("rerun")
    result = sfm("view", model_folder, "--save", "scene.rrd")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "scene.rrd").stat().st_size > 1000

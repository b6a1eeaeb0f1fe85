import pickle
from pathlib import Path

import pytest

from sfm.core import errors
from sfm.core.errors import ConfigError, ExitCode, FormatError, ImageError, InputError, Rejected, SfmError

KINDS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, SfmError)]


def test_an_error_is_one_line_of_path_cause_and_remedy():
    error = ImageError("the file ends early", path=Path("a/b.jpg"), remedy="copy it again")
    assert str(error) == "a/b.jpg: the file ends early — copy it again"
    assert str(SfmError("no idea")) == "no idea"
    assert str(FormatError("no header", path="x.ply")) == "x.ply: no header"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_errors_come_back_whole_from_another_process(kind, protocol):
    error = kind("cause", path=Path("p"), remedy="remedy")
    again = pickle.loads(pickle.dumps(error, protocol))
    assert type(again) is kind
    assert (again.cause, again.path, again.remedy, str(again)) == ("cause", Path("p"), "remedy", str(error))
    assert again.exit_code == kind.exit_code


@pytest.mark.parametrize("kind", KINDS)
def test_every_error_has_the_exit_code_of_a_failure(kind):
    assert isinstance(kind.exit_code, ExitCode)
    assert kind.exit_code not in (ExitCode.OK, ExitCode.BUG)


def test_exit_codes_are_those_that_the_manual_names():
    assert {code.name: code.value for code in ExitCode} == {
        "OK": 0,
        "BUG": 1,
        "USAGE": 2,
        "BAD_INPUT": 3,
        "RECONSTRUCTION_FAILED": 4,
        "QUALITY_GATE_FAILED": 5,
        "MISSING_DEPENDENCY": 6,
        "WORKSPACE_LOCKED": 7,
        "INTERRUPTED": 130,
    }
    assert issubclass(ConfigError, InputError)
    assert ConfigError.exit_code is ExitCode.USAGE


def test_a_rejection_is_a_falsy_value_that_can_be_counted():
    rejected = Rejected("too_few_inliers", "11 of 15 needed")
    assert not rejected
    assert rejected == Rejected("too_few_inliers", "11 of 15 needed")
    assert len({rejected, pickle.loads(pickle.dumps(rejected)), Rejected("other")}) == 2
    assert not isinstance(rejected, Exception)

"""What calibration programs write as YAML is read as they mean it; the rest is refused by line."""

from __future__ import annotations

import json

import hypothesis.strategies as st
import pytest
from hypothesis import given

from sfm.io.yaml_text import parse_yaml

OPENCV = """%YAML:1.0
---
nframes: 13
calibration_time: "Wed 08 Nov 2017 01:02:03 PM"
# a line of remarks
camera_matrix: !!opencv-matrix
   rows: 2
   cols: 2
   dt: d
   data: [ 5.3591573396163199e+02, 0., -1.,
       .5, 1e-3 ]
flags: 2   # and one behind
names: [ "left01.jpg", "right #1.jpg" ]
empty:
...
"""
SEQUENCES = """cam0:
  T_cn_cnm1:
  - [0.1, 0.2]
  - [0.3, 1.0]
  nested:
  - - 0.99
    - 0.01
  - - 1
    - 2
  rostopic: /cam0/image_raw
  settings:
    - key: a
      value: 1
    - key: b
      value: {x: 1, "y y": [~, true], z: }
"""


def test_opencv_s_dialect_is_read():
    found = parse_yaml(OPENCV)
    assert found["camera_matrix"] == {"rows": 2, "cols": 2, "dt": "d", "data": [535.91573396163199, 0.0, -1, 0.5, 1e-3]}
    assert found["nframes"] == 13
    assert found["flags"] == 2
    assert found["names"] == ["left01.jpg", "right #1.jpg"]
    assert found["calibration_time"].endswith("PM")
    assert found["empty"] is None


def test_lists_may_stand_below_their_key_and_within_one_another():
    found = parse_yaml(SEQUENCES)["cam0"]
    assert found["T_cn_cnm1"] == [[0.1, 0.2], [0.3, 1.0]]
    assert found["nested"] == [[0.99, 0.01], [1, 2]]
    assert found["rostopic"] == "/cam0/image_raw"
    assert found["settings"] == [
        {"key": "a", "value": 1},
        {"key": "b", "value": {"x": 1, "y y": [None, True], "z": None}},
    ]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1.", 1.0), ("-.5e+3", -500.0), ("1_000", "1_000"), ("0x10", "0x10"), ("-7", -7), ("~", None), ("No", "No"),
        (".inf", float("inf")), ("'it''s'", "it's"), (r'"a\"b\n"', 'a"b\n'), ("a: b", {"a": "b"}), ("", None),
        ("http://a:80/b", "http://a:80/b"), ("!!float 3", 3), ("[]", []), ("- ", [None]), ("--- 5", 5),
    ],
)  # fmt: skip
def test_scalars_are_what_they_look_like(text, value):
    assert parse_yaml(text) == value


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: 1\na: 2", "line 2 has the key 'a' for the second time"),
        ("a: &x 1", "line 1 uses '&'"),
        ("a: |\n  text", "line 1 uses '|'"),
        ("a: [1, 2", "line 1 opens a bracket that is not closed"),
        ("a: [1, 2}", "brackets of different kinds"),
        ("a: ]", "closes a bracket that is not open"),
        ("a: [1] 2", "goes on behind its last bracket"),
        ("a: {b, c: 1}", "no value for 'b'"),
        ("a: 1\n   b: 2", "line 2 is indented otherwise"),
        ("a:\n    b: 1\n  c: 2", "line 3 is indented otherwise"),
        ("a: 1\nword", "line 2 is neither a key nor an item"),
        ("\ta: 1", "line 1 is indented by a tab"),
        ("a: 'open", "line 1 has a quote that is not closed"),
        ("[" * 60 + "]" * 60, "nested too deep"),
        ("\n".join(" " * k + "a:" for k in range(60)), "nested too deep"),
    ],
)
def test_what_is_not_known_is_refused_by_its_line(text, told):
    with pytest.raises(ValueError, match="line ") as refused:
        parse_yaml(text)
    assert told in str(refused.value)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)


@given(value=values)
def test_json_is_yaml(value):
    text = json.dumps(value, ensure_ascii=True).replace("\\u", "u")
    assert parse_yaml(text) == json.loads(text)


@given(text=st.text(alphabet="a:-[]{},#\"' \n1.&!|%", max_size=40))
def test_no_text_ends_in_anything_but_a_value_or_a_named_line(text):
    told = "line 0"
    try:
        parse_yaml(text)
    except ValueError as error:
        told = str(error)
    assert told.startswith("line ")

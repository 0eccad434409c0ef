"""YAML of strangers: plain values or one error."""

import pytest

from lvba.errors import InputError
from lvba.io import plain_yaml


def test_plain_values_and_what_opencv_writes():
    text = "%YAML:1.0\na: [1, 2.5, x, null]\nm: !!opencv-matrix\n  rows: 1\n  data: [3]\n"
    assert plain_yaml.load(text, "f") == {"a": [1, 2.5, "x", None], "m": {"rows": 1, "data": [3]}}


def test_opencv_needs_no_space_behind_a_name():
    text = 'Viewer.PointSize:2\na:-1.5\nb:"x:1"\nc: d:3\n'
    assert plain_yaml.load("%YAML:1.0\n" + text, "f") == {
        "Viewer.PointSize": 2,
        "a": -1.5,
        "b": "x:1",
        "c": "d:3",
    }
    with pytest.raises(InputError, match=r"f:\d: not YAML"):
        plain_yaml.load(text, "f")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [1", r"f:1: not YAML"),
        ("a: &x [1]\nb: *x\n", r"f:2: not YAML \(aliases"),
        ("a: !!python/object/apply:os.system [true]", r"f:1: not YAML"),
        ("a: \x01", "not YAML"),
        ("a: 2021-13-45", "invalid value: month must be in"),
        ("a: !!binary ä", "not YAML"),
        ("a: !!int x", "invalid value"),
        ("[" * 3000, "nested too deep"),
        ("{[1]: 2}", "not YAML"),
        ("a: !!opencv-matrix 3", "a matrix must be a mapping"),
    ],
)
def test_all_else_is_one_error_of_little_length(text, said):
    with pytest.raises(InputError, match=said) as caught:
        plain_yaml.load(text, "f")
    assert len(str(caught.value)) < 400

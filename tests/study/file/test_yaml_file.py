"""The strict reader: what a file says, or why not, with the line."""

from __future__ import annotations

import contextlib
import json

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.yaml_file import parse_yaml, read_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("1.0e-6", 1e-6),
        ("-.5", -0.5),
        ("1.", 1.0),
        ("45", 45),
        ("-90", -90),
        ("true", True),
        ("False", False),
        ("~", None),
        ("on", "on"),
        ("yes", "yes"),
        ("NO", "NO"),
        ("007", "007"),
        ("0x1F", "0x1F"),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("2026-01-01", "2026-01-01"),
        (".nan", ".nan"),
        (".inf", ".inf"),
        ("'1e-4'", "1e-4"),
        ('"true"', "true"),
    ],
)
def test_a_scalar_is_what_it_looks_like(text, value):
    data = parse_yaml(f"key: {text}").data["key"]
    assert data == value
    assert type(data) is type(value)


def test_lines_are_kept_for_every_path():
    document = parse_yaml("a: 1\nb:\n  - x\n  - {c: 2}\n")
    assert document.data == {"a": 1, "b": ["x", {"c": 2}]}
    assert document.lines[("a",)] == 1
    assert document.lines[("b", 0)] == 3
    assert document.lines[("b", 1, "c")] == 4


def faults(text):
    with pytest.raises(StudyError) as caught:
        parse_yaml(text, "f.yaml")
    return [(fault.where, fault.text) for fault in caught.value.faults]


def test_every_duplicate_is_named_with_both_lines():
    result = faults("a: 1\nb: {c: 1,\n  c: 2}\na: 3\n")
    assert [line for line, _ in result] == [3, 4]
    assert "first in line 1" in result[-1][1]
    assert all("given twice" in text for _, text in result)


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("a: 1\nb: !!python/object/apply:os.system ['true']", 2, "tag"),
        ("!!python/name:os.system a: 1", 1, "tag"),
        ("a: &x [1]\nb: *x", 1, "anchors"),
        ("a: 1\n---\nb: 2", 2, "second document"),
        ("a: [1, 2", 1, "not YAML"),
        ("a: 1\n\tb: 2", 2, "not YAML"),
        ("? [a, b]\n: 1", 1, "key"),
        ("a: 1e999", 1, "the largest float"),
        ("a: " + "9" * 5000, 1, "digits"),
        ("a: " + "[" * 5000, 1, "deep"),
        ("a: \x07", 1, "not YAML"),
    ],
)
def test_what_is_refused(text, line, word):
    result = faults(text)
    assert any(word in message for _, message in result)
    assert result[0][0] == line


@pytest.mark.parametrize(("content", "word"), [(b"\xff\xfe\x00", "UTF-8"), (b"a: 1\n" * 300_000, "bytes")])
def test_files_that_are_no_text(tmp_path, content, word):
    file = tmp_path / "f.yaml"
    file.write_bytes(content)
    with pytest.raises(StudyError, match=word):
        read_yaml(file)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(StudyError, match="No such file"):
        read_yaml(tmp_path / "missing.yaml")


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(st.text(max_size=80) | st.text(alphabet="ab:- \n[]{},&*!?|>'\"#%@`1.e", max_size=60))
def test_any_text_is_read_or_refused_with_a_reason(text):
    """No other exception than StudyError leaves the reader, and that one has a reason."""
    with contextlib.suppress(StudyError):
        parse_yaml(text)
        return
    assert faults(text)


leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(10**15), 10**15)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text("abc \n:#'\"é-1e", max_size=8)
)
trees = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text("abc.", min_size=1, max_size=3), inner, max_size=3)
    ),
    max_leaves=8,
)


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(trees)
def test_what_json_writes_is_read_back(tree):
    """JSON is YAML: an independent writer of the same data."""
    assert parse_yaml(json.dumps(tree, ensure_ascii=False)).data == tree


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(st.dictionaries(st.sampled_from(["a", "b.c", "d"]), trees, max_size=3))
def test_what_pyyaml_writes_is_read_back(tree):
    assert parse_yaml(yaml.safe_dump(tree)).data == tree

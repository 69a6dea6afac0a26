"""The JSON schema: it accepts the shipped files and marks what an editor should mark."""

from __future__ import annotations

from pathlib import Path

import jsonschema
import pytest
import yaml

import torchmbd as mbd
from torchmbd.study.file.config_index import configs
from torchmbd.study.file.json_schema import json_schema, meanings
from torchmbd.study.file.yaml_file import read_yaml

FILES = [Path(__file__).parents[1].joinpath("study.yaml"), *configs(Path(__file__).parents[3] / "configs")]
VALID = yaml.safe_load(FILES[0].read_text())


@pytest.fixture(scope="module")
def validator():
    jsonschema.Draft202012Validator.check_schema(json_schema())
    return jsonschema.Draft202012Validator(json_schema())


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(file, id=file.stem, marks=[pytest.mark.extensions] if "identify" in read_yaml(file).data else [])
        for file in FILES
    ],
)
def test_valid_files_are_valid(validator, file):
    validator.validate(read_yaml(file).data)


@pytest.mark.parametrize(
    "change",
    [
        {"modl": "x"},
        {"optimizer": {"name": "mmdf"}},
        {"design": {"a": {"lower": 0, "upper": 1, "unit": "degree"}}},
        {"starts": {"sampler": "sobel"}},
        {"simulate": {"duration": -1}},
        {"simulate": {"duration": 1.0, "method": "hht_alpha", "alpha": "strong"}},
        {"simulate": {"duration": 1.0, "iterations": [3, "x"]}},
        {"subject_to": [{"max": {"strain_energy": "rod"}}]},
        {"figures": "a:b"},
    ],
)
def test_invalid_files_are_marked(validator, change):
    assert not validator.is_valid(VALID | change)


def test_every_key_has_a_meaning():
    schema = json_schema()
    for section in schema["$defs"].values():
        for key, entry in section["properties"].items():
            assert entry.get("description"), key


def test_arguments_have_their_meaning():
    def documented():
        """What it does.

        first, second   how long [m];
                        "initial": as at the start
        third   as in `other`
        fourth  a word

        Not an entry  of the table; see above.
        """

    length = 'how long [m]; "initial": as at the start'
    assert meanings(documented.__doc__) == {"first": length, "second": length, "fourth": "a word"}
    assert meanings(mbd.Problem.__doc__)["tolerance"].startswith("largest error due to time steps that each response")

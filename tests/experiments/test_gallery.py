"""The mechanisms of the gallery are what their pictures show: closed, no row redundant, with their freedoms."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch

import torchmbd as mbd
from experiments.documentation.pictures import PICTURES

ROOT = Path(__file__).parents[2]
RIGID = {"four_bar": 0, "chain": 5, "spacecraft": 0, "delta_robot": 0, "flapping_blade": 0, "falling_arm": 2}


@pytest.mark.parametrize("name", RIGID)
def test_a_mechanism_is_closed_and_has_its_freedoms(name):
    system = importlib.import_module(f"experiments.models.{name}").build()
    text = str(system.describe())
    assert "redundant   none" in text, text
    assert f"({RIGID[name]} of rigid bodies)" in text, text
    motion = mbd.simulate(system, 1e-3, steps=4, gradients="none", backend="eager")
    assert bool(torch.isfinite(motion.q).all())


def test_every_picture_is_shown_and_small():
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    files = {file.stem: file.stat().st_size for file in (ROOT / "docs" / "images").iterdir()}
    assert set(files) == set(PICTURES)
    assert all(f"images/{name}.svg" in page for name in PICTURES)
    assert sum(files.values()) < 1_000_000

"""The warning of spin: said of lanes that are known, silent on those that failed and on bodies that nothing holds."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import pytest
import torch

from torchmbd.results import spin


@pytest.mark.parametrize(
    ("ratios", "said"),
    [([0.05, torch.nan, torch.inf], None), ([0.05, torch.nan, 0.3], "0.3 of its first"), ([torch.nan], None)],
)
def test_only_known_ratios_count(monkeypatch: pytest.MonkeyPatch, ratios: list[float], said: str | None) -> None:
    monkeypatch.setattr(spin, "spin_ratios", lambda motion: {"rod": torch.tensor(ratios)})
    motion = SimpleNamespace(stats={}, dynamics=SimpleNamespace(data={}))
    if said is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            spin.warn_of_spin(motion)  # type: ignore[arg-type]
    else:
        with pytest.warns(UserWarning, match=said):
            spin.warn_of_spin(motion)  # type: ignore[arg-type]
    assert motion.stats["spin_ratio"]["rod"].shape == (len(ratios),)

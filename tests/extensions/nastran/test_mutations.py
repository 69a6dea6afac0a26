"""200 spoilt decks: each makes a body, or an InputError; none a traceback, none takes long."""

from __future__ import annotations

import random
import time
import warnings

import pytest

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from torchmbd.errors import InputError

EXTRA = [
    "CORD2R,4,0,0.,0.,0.,0.,0.,1.\n,1.,0.,0.",
    "GRID,900,,.2,0.,.1,4",
    "CBUSH,901,9,301,900,0.,0.,1.\nPBUSH,9,K,1.+5,1.+5,1.+5,1.+3,1.+3,1.+3",
    "CONROD,902,900,102,2,1.-4,1.-8",
    "CBAR,903,8,101,102,0.,0.,1.\nPBARL,8,2,,BAR\n,.01,.02",
    "MAT1,2,70.+9,,.3,2700.",
    "CONM2,904,900,0,.7,0.,0.,0.1\n,1.-3,,1.-3,,,1.-3",
    "GRID,910,,.16,.06,0.\nRBE2,905,402,123456,910",
    "FORCE,1,401,0,1.,0.,0.,1.",
    "CBAR,906,8,103,203,0.,0.,1.,GOO\n,46,5,0.,0.,.01,.02,0.,.01",
    "CBEAM,907,11,201,202,0.,0.,1.\nPBEAML,11,2,,L\n,.02,.03,.002,.002,,NO,1.,.02\n,.03,.002,.002",
    "CBEAM,908,12,302,303,0.,0.,1.\nPBEAM,12,2,2.-5,3.-10,2.-10,,4.-10\n,\n,NO,1.,3.-5\n,\n,1.,1.",
    "GRID,911,,.16,.06,.01\nRBE2,909,910,123456,911",
    "GRID,913,,.16,.06,.02\nGRID,914,,.1,.06,.02\nCSHEAR,910,14,402,403,913,914\nPSHEAR,14,2,.001,,1.,1.",
    "PSHELL,15,2,.001,2,1.2,2\nGRID,915,,.2,0.,.05\nCTRIA3,911,15,402,915,403,0.,.001\nSPOINT,990,THRU,993\nCELAS2,912,1.,990,,991",
    "PCOMPG,13\n,1,1,.001,30.\n,2,1,.001,-30.\nGRID,912,,.2,0.,.1\nCTRIA3,909,13,402,912,403,0.",
]
ALPHABET = "0123456789.,+-*$' ABCDEGRTHU\t\x00é"


def spoilt(text: str, seed: int) -> str:
    """A deck with one to four accidents: a changed or lost character, field or line, lines twice, out of turn or cut off."""
    draw = random.Random(seed)
    for _ in range(draw.randint(1, 4)):
        lines = text.splitlines()
        k = draw.randrange(len(lines))
        kind = draw.randrange(8)
        if kind == 0 and text:
            place = draw.randrange(len(text))
            text = text[:place] + draw.choice(ALPHABET) + text[place + 1 :]
            continue
        fields = lines[k].split(",")
        f = draw.randrange(len(fields))
        if kind == 1:
            fields[f] = draw.choice(["", "-1", "0", "1e999", "NaN", "999999999999", "THRU", "1.+99", "x", "0.", "-7."])
        elif kind == 2:
            del fields[f]
        elif kind == 3:
            fields.insert(f, draw.choice(["", "3", "7.", "SYM"]))
        lines[k] = ",".join(fields)
        if kind == 4:
            del lines[k]
        elif kind == 5:
            lines.insert(k, draw.choice(lines))
        elif kind == 6:
            other = draw.randrange(len(lines))
            lines[k], lines[other] = lines[other], lines[k]
        elif kind == 7:
            lines[k] = lines[k][: draw.randrange(len(lines[k]) + 1)]
        text = "\n".join(lines)
    return text


@pytest.mark.thorough
@pytest.mark.parametrize("start", [0, 50, 100, 150])
def test_spoilt_decks(start, tmp_path):
    path = tmp_path / "model.bdf"
    deck = model(cells=(4, 2), extra=EXTRA)
    refused, slowest = 0, 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path.write_text(deck)
        mbd.io.read_bdf(path, "plate", modes=2)
        for seed in range(start, start + 50):
            path.write_text(spoilt(deck, seed))
            began = time.process_time()
            try:
                mbd.io.read_bdf(path, "plate", modes=2)
            except InputError:
                refused += 1
            slowest = max(slowest, time.process_time() - began)
    assert 5 < refused < 50
    assert slowest < 5.0

"""What decks of others hold besides the plain case: names of continuations, plies of SOUT alone, RBAR1, sets of supports."""

from __future__ import annotations

import time
import warnings

import pytest
import torch

from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body

SQUARE = (
    "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,1.,1.,0.\nGRID,4,,0.,1.,0.\nCQUAD4,1,1,1,2,3,4\n"
    "MAT1,1,7.+10,,.3,2700.\nPSHELL,1,1,.01,1\nGRID,5,,0.,0.,1.\nGRID,6,,0.,0.,2.\n"
)


@pytest.fixture
def read(tmp_path):
    def made(*lines: str, start: str = SQUARE):
        path = tmp_path / "model.bdf"
        path.write_text(start + "\n".join(lines), encoding="utf-8")
        return bulk_body(path)

    return made


def small(*fields: str) -> str:
    return "".join(f"{word:8}" for word in fields)


def test_continuations_are_found_by_name(read):
    """Each below its line: plies as written, also where cards take the same names; apart from it: refused."""
    stack = SQUARE.replace("PSHELL,1,1,.01,1\n", "")
    lines = [small("PCOMP", "1", *[""] * 7, "+A"), small("+A", "1", ".001", "0.", "YES", "", ".002", "90.")]
    other = [small("PCOMP", "2", *[""] * 7, "+B"), small("+B", "1", ".004", "0.", "YES")]
    assert read(*lines, *other, start=stack).parts["pcomp_1"].laminate.thickness.tolist() == [0.001, 0.002]
    same = [line.replace("+B", "+A") for line in other]
    assert len(read(*lines, *same, start=stack).parts) == 1
    with refused("model.bdf, line 12", ANY, "'A'"):
        read(lines[0], *other, lines[1], start=stack)


def test_sout_alone_makes_a_ply(read):
    """MID and T are those of the ply before it, its angle is 0."""
    stack = SQUARE.replace("PSHELL,1,1,.01,1\n", "")
    laminate = read("PCOMP,1", ",1,.001,30.,YES,,,,YES", start=stack).parts["pcomp_1"].laminate
    assert laminate.thickness.tolist() == [0.001, 0.001]
    assert torch.rad2deg(laminate.angles).tolist() == pytest.approx([30.0, 0.0])


def test_a_byte_order_mark_is_no_card(read):
    assert read(start="\ufeff" + SQUARE).mesh.quads.shape == (1, 4)


def test_rbar1_is_an_rbe2_of_one_grid(read):
    (link,) = read("RBAR1,7,1,5,123").links
    assert (link.node, link.leader, link.components) == (4, 0, (0, 1, 2))
    (link,) = read("RBAR1,7,1,5").links
    assert link.components == (0, 1, 2, 3, 4, 5)


def test_a_tube_of_thickness_zero_is_solid(read):
    solid, blank = (read("CTUBE,8,2,1,5", f"PTUBE,2,1,.1,{t}").parts["ctube"] for t in ("0.", ""))
    assert torch.equal(solid.values(), blank.values())


@pytest.mark.thorough
def test_many_scalar_points(read):
    """8,000 single SPOINT and as many springs between grids are read in seconds: their numbers are searched, not scanned."""
    n = 8_000
    lines = [f"SPOINT,{10**6 + 2 * k}" for k in range(n)]
    lines += [f"CELAS2,{100 + k},1.,1,1,2,1" for k in range(n)]
    began = time.process_time()
    read(*lines)
    assert time.process_time() - began < 8.0


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["SPC1,1,123456,1,4", "SPC1,2,123456,2"], ["SPC sets [1, 2] hold together", "case control"]),
        (["MPC,1,1,1,1.,2,1,-1.", "MPC,2,3,1,1.,4,1,-1."], ["MPC sets [1, 2] hold together"]),
        (
            ["SPC1,1,12345,3,4"],
            ["2 grids, the first is 3, components 12345 by SPC1 1 (model.bdf, line 10)", "left out"],
        ),
        (["RBE3,7,,5,123,1.,123456,1,2", ",3,4"], ["RBE3 7", "C is '123456'", "rotations"]),
    ],
)
def test_what_differs_from_the_deck_is_said(lines, words, read):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read(*lines)
    text = "\n".join(str(own.message) for own in caught)
    assert all(word in text for word in words), text


def test_sets_that_are_added_hold_together_without_a_word(read, recwarn):
    read("SPC1,1,123456,1,4", "SPC1,2,123456,2", "SPCADD,9,1,2")
    assert not any("hold together" in str(own.message) for own in recwarn.list)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["CORD2R,5,,0.,0.,0.,0.,0.,1.", ",1.,0.,0."] * 2, ["CORD2R 5", "line 12", "taken by", "line 10"]),
        (["CORD2R,0,,0.,0.,0.,0.,0.,1.", ",1.,0.,0."], ["CORD2R 0", "CID = 0"]),
        (["CTETRA,8,2,1,2,3,5", "CTETRA,8,2,1,2,4,5", "PSOLID,2,1"], ["CTETRA 8", "line 11", "twice", "line 10"]),
        (["CONM2,8,1,,2."] * 2, ["CONM2 8", "line 11", "appears twice"]),
        (["CORD2C,5,,0.,0.,0.,0.,0.,1.", ",1.,0.,0.", "CONM2,8,2,5,1.,.2,90."], ["CONM2 8", "CID 5 is curved"]),
        (["SPC1,1,ABC,1"], ["SPC1 1", "'ABC'", "components 1 to 6"]),
        (["SPC1,1,17,1"], ["SPC1 1", "'17'"]),
        (["RBE2,7,1,123456,1"], ["RBE2 7", "GRID 1 follows itself"]),
        (["RBE2D,7,1,123456,5"], ["RBE2D 7", "cannot be read"]),
        (["CTETRA,8,2,1,2,3,5", "PSOLID,2,7", "MAT11,7,1.+9"], ["PSOLID 2", "material 7", "MAT9"]),
    ],
)
def test_what_is_refused(lines, words, read):
    with pytest.raises(InputError) as error:
        read(*lines)
    assert all(word in str(error.value) for word in ["model.bdf, line", *words]), str(error.value)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "model.bdf"
    with path.open("wb") as file:
        file.truncate(10**12)  # takes no place on the disk
    with refused("model.bdf"):
        bulk_body(path)


def test_chains_are_bounded(read, tmp_path):
    """Files and systems that refer to one another: no recursion to the depth of the interpreter."""
    for k in range(300):
        (tmp_path / f"f{k}.bdf").write_text(f"INCLUDE 'f{k + 1}.bdf'\n")
    with refused("f100.bdf.INCLUDE", ANY, "100"):
        read("INCLUDE 'f0.bdf'")
    lines = [f"CORD2R,{k},{k - 1},0.,0.,0.,0.,0.,1.\n,1.,0.,0." for k in range(2, 3000)]
    with refused("CORD2R 2899 (model.bdf, line 5806).RID", ANY, "100"):
        read("CORD2R,1,,0.,0.,0.,0.,0.,1.\n,1.,0.,0.", *lines, "GRID,9,2999,1.,0.,0.")

"""What is neither read nor known to carry no mass, stiffness or support is refused."""

from __future__ import annotations

import pytest

from tests.refused import ANY, refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.extensions.nastran.inert import is_inert

SQUARE = (
    "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,1.,1.,0.\nGRID,4,,0.,1.,0.\nCQUAD4,1,1,1,2,3,4\n"
    "MAT1,1,7.+10,,.3,2700.\nPSHELL,1,1,.01,1\n"
)
DMIG = "DMIG,KX,0,6,1\nDMIG,KX,3,3,,3,3,100.\n"


def read(tmp_path, bulk: str, control: str | None = None):
    path = tmp_path / "model.bdf"
    path.write_text(("" if control is None else f"SOL 103\nCEND\n{control}\nBEGIN BULK\n") + SQUARE + bulk)
    return bulk_body(path)


@pytest.mark.parametrize(
    "card",
    [
        *(
            "CONM1,5,1,,2.",
            "CBUSH1D,5,1,1,2",
            "CGAP,5,1,1,2",
            "CBEND,5,1,1,2",
            "GENEL,5",
            "CFAST,5",
            "CQUADX4,5",
            "CELAS5,5",
        ),
        *(
            "RBE1,5",
            "RSPLINE,5",
            "MPCAX,5",
            "MFLUID,5,1",
            "GMSPC,5",
            "SPCAX,5",
            "TF,5,1,1",
            "BGSET,5",
            "BCTABLE,5",
            "CSUPER,5",
        ),
        *("FEEDGE,5,3,2", "AXIC,4", "CYJOIN,1", "SEBULK,1", "RELEASE,5", "NOLIN1,5", "MYCARD,5", "5.,6.", "GRIDB,7"),
        *("GMCURV,5", "RINGAX,5", "NLRGAP,5", "ACMODL,1", "CHACAB,5", "SWLDPRM,A,1", "CTRIAX6,5", "RSPINR,5", "UEL,5"),
    ],
)
def test_cards_that_are_not_known(card, tmp_path):
    with pytest.raises(InputError) as caught:
        read(tmp_path, card)
    assert caught.value.argument.endswith(" (model.bdf, line 8)")


@pytest.mark.parametrize(
    "card",
    [
        *(
            "FORCE,1,3,,1.,0.,0.,1.",
            "PLOAD4,1,1,1.",
            "GRAV,1,,9.8,0.,0.,-1.",
            "TEMP,1,3,20.",
            "SPCD,1,3,3,.1",
            "TABLED1,5",
        ),
        *(
            "TABDMP1,5",
            "TABRND1,5",
            "DTABLE,Y,1.",
            "PCOMPS,5",
            "CBARAO,5",
            "BOLT,5",
            "AEFACT,5",
            "MONPNT1,A",
            "PLOAD1,5",
            "MAT4,5",
        ),
        *(
            "CAERO1,5",
            "SPLINE1,5",
            "AERO,5",
            "SET1,5,1",
            "DESVAR,5,X,1.",
            "DVPREL1,5",
            "DRESP1,5",
            "CDAMP2,5,1.",
            "PBUSHT,5",
        ),
        *(
            "PMASS,5,1.",
            "MATS1,5",
            "SUPORT1,1,3,3",
            "ASET1,3,3",
            "TLOAD1,5",
            "FREQ1,5",
            "EIGRL,5",
            "DMI,X,0",
            "QBDY3,5",
        ),
    ],
)
def test_cards_that_carry_nothing(card, tmp_path):
    assert len(read(tmp_path, card).parts) == 1
    assert is_inert(card.partition(",")[0])


def test_matrices_of_the_case_control(tmp_path):
    """Refused by name where they are added to mass or stiffness; dampers and other matrices are left out with a word."""
    for command in ("K2GG = KX", "M2GG=KX", "k2gg = 2.0*KX", "K2PP = A,\n KX", "SUBCASE 1\n K2GG = KX", "K42GG = KX"):
        with pytest.raises(
            InputError, match=r"DMIG KX \(model.bdf, line \d+\): the case control \(model.bdf, line \d\) adds"
        ):
            read(tmp_path, DMIG, command)
    with pytest.raises(InputError, match=r"DMIG KX .*: the file has no case control, which may add it"):
        read(tmp_path, DMIG)
    with refused("model.bdf, line 3", ANY, "KX"):
        read(tmp_path, "", "K2GG = KX")
    for command in ("B2GG = KX", "SPC = 1"):
        with warned("DMIG", "case control"):
            read(tmp_path, DMIG, command)


@pytest.mark.parametrize("name", ["CM1", "CK1"])
def test_parameters_that_multiply_matrices(name, tmp_path):
    read(tmp_path, f"PARAM,{name},1.")
    with pytest.raises(
        InputError, match=rf"PARAM {name} \(model.bdf, line 8\): {name} is 2., but read_bdf .* multiplies the"
    ):
        read(tmp_path, f"PARAM,{name},2.")
    with pytest.raises(InputError, match=rf"PARAM {name} \(model.bdf, line 3\)"):
        read(tmp_path, "", f"PARAM,{name},2.")


def test_materials_that_depend_on_temperature(tmp_path):
    """They have the numbers of their MAT1 while no command gives them a temperature; else they are refused."""
    for command in ("TEMP = 7", "TEMPERATURE(INITIAL)=7", "TEMP(MATE) = 7", None):
        with pytest.raises(InputError, match=r"MATT1 1 \(model.bdf, line \d+\): the case control .* temperature"):
            read(tmp_path, "MATT1,1,5", command)
    for command in ("TEMP(LOAD) = 7", "TEMPERATURE(LOAD)=7", "SPC = 1"):
        with warned("MATT1 (1)"):
            read(tmp_path, "MATT1,1,5", command)


def test_drilling_stiffness_of_nastran_is_told(tmp_path):
    """K6ROT is a number that Nastran gives to rotations about the normal; here they have stiffness of their own."""
    with warned("PARAM K6ROT"):
        read(tmp_path, "PARAM,K6ROT,1.")

"""Bodies from Nastran models: against bodies made by hand, in every format of an element, and what is refused."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import scipy.linalg
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from tests.fem.elements.plate_cases import GENERAL, freedoms
from tests.refused import refused, warned
from torchmbd.errors import InputError
from torchmbd.fem.elements import PlateMatrices


@pytest.fixture
def body(tmp_path):
    """Read the text of a model."""

    def read(text: str, modes: int = 4, **given) -> mbd.FlexibleBody:
        file = tmp_path / "model.bdf"
        file.write_text(text)
        return mbd.io.read_bdf(file, "plate", modes, **given)

    return read


def values(body: mbd.FlexibleBody) -> torch.Tensor:
    return torch.linalg.eigvalsh(body.structure()["Kr"].detach())


def stack(angles) -> mbd.Laminate:
    return mbd.Laminate(GENERAL.plies, mbd.deg(angles), [1e-3, 2e-3, 1.5e-3], shear_correction="energy")


def by_hand(angles=(20.0, -50.0, 75.0), kind="quad") -> torch.Tensor:
    mesh = mbd.mesh.rectangle(0.3, 0.1, (6, 2), kind)
    return values(mbd.FlexibleBody.plate("plate", mesh, stack(angles), 4, reference="left_edge"))


def with_shear(angles, As: torch.Tensor) -> torch.Tensor:
    """The same of quadrilaterals with another transverse shear stiffness than the laminate's own."""
    mesh, laminate = mbd.mesh.rectangle(0.3, 0.1, (6, 2), "quad"), stack(angles)
    plate, law = PlateMatrices(mesh, laminate), laminate.stiffness()
    K = plate.pattern.to_scipy(plate.stiffness(law._replace(As=As).entries().detach()).values)
    M = plate.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area).detach().numpy()
    free = np.setdiff1d(np.arange(len(M)), freedoms(mesh.node_set("left_edge")))
    squares = scipy.linalg.eigh(K[free][:, free].toarray(), np.diag(M[free]), eigvals_only=True)
    return torch.from_numpy(squares[:4])


def turned_shear(angle: float) -> torch.Tensor:
    """As of the stack of the model in its own axes, seen from axes turned back by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    return R @ stack((20.0, -50.0, 75.0)).stiffness().As.detach() @ R.T


@pytest.mark.thorough
def test_a_laminated_model_is_the_body_made_by_hand(body):
    """Same mesh, laminate and clamp: the same modes; PCOMP angles are the parameters."""
    result = body(model())
    assert [name for name, x in result.named_parameters() if x.requires_grad] == ["laminate.angles"]
    assert torch.rad2deg(result.laminate.angles.detach()).tolist() == pytest.approx([20.0, -50.0, 75.0])
    assert result.laminate.layer_plies[0].strength.Yc == pytest.approx(2.46e8)
    assert result.reference == list(result.mesh.node_set("spc_1"))
    assert_close(values(result), by_hand(), rtol=1e-9, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "given",
    [
        {"millimeters": True},
        {"triangles": True},
        {"corners": lambda a, b, c, d: (b, c, d, a), "theta": "-90."},
        {"corners": lambda a, b, c, d: (c, d, a, b), "theta": "180."},
        {"theta": "0"},
        {
            "theta": "4",
            "extra": ["CORD2R,4,0,1.,2.,0.,1.,2.,5.", ",2.,2.,0."],
            "corners": lambda a, b, c, d: (d, a, b, c),
        },
    ],
    ids=["mm", "triangles", "first side along y", "first side along -x", "basic system", "system"],
)
def test_units_elements_and_material_directions(given, body):
    """The same plate written otherwise is the same plate. (Triangles need THETA 0 along their first side: here x.)"""
    if given.get("triangles"):
        given = given | {"theta": "0"}  # the basic system's x axis
    result = body(model(**given), units="mm" if given.get("millimeters") else "m")
    kind = "triangle" if given.get("triangles") else "quad"
    assert_close(values(result), by_hand(kind=kind), rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_theta_turns_the_laminate(body):
    """THETA 30 is 30 degrees on every ply, but for As of equal energy, which looks along the laminate's axes.

    That is all of it: with As of the stack as it lies in the file, the turned plies have its modes to rounding.
    """
    turned, own = values(body(model(theta="30.")))[:4], by_hand((50.0, -20.0, 105.0))[:4]
    assert_close(turned, with_shear((50.0, -20.0, 105.0), turned_shear(math.pi / 6)), rtol=1e-8, atol=0)
    assert 1e-4 < float((turned / own - 1).abs().max()) < 6e-3
    assert float((own / by_hand()[:4] - 1).abs().max()) > 0.05


RIGID_END = ["GRID,900,,.2,0.,.03", "RBE2,30,900,123456,601,602,603", "CONM2,31,900,0,.7,,,,", ",1.-4,,1.-4,,,1.-4"]


@pytest.mark.thorough
def test_rbe2_and_conm2(body):
    """A rigid end with a mass on an arm: its motion is rigid, mass and center are right, and a frame may sit there."""
    result = body(model(extra=RIGID_END), modes=2)
    psi = result.structure()["psi"].detach()
    tip = result.mesh.node("rbe2_30")
    assert result.mesh.node("conm2_31") == result.mesh.node("grid_900") == tip
    for grid in (601, 602, 603):
        node = result.mesh.node(f"grid_{grid}")
        d = (result.mesh.nodes[node] - result.mesh.nodes[tip])[:, None].expand(3, 2)
        assert_close(psi[node, :3], psi[tip, :3] + torch.linalg.cross(psi[tip, 3:], d, dim=0), rtol=1e-9, atol=1e-9)
    plain, loaded = body(model()).structure(), result.structure()
    assert_close(loaded["mass"] - plain["mass"], torch.tensor(0.7, dtype=torch.float64))
    assert_close(loaded["S0"] - plain["S0"], 0.7 * torch.tensor([0.35, 0.0, 0.03], dtype=torch.float64))
    assert_close(loaded["mu"] - plain["mu"], torch.tensor(1e-4, dtype=torch.float64))
    assert result.at("rbe2_30").point.tolist() == pytest.approx([0.35, 0.0, 0.03])
    assert float(values(result)[0]) < 0.1 * float(values(body(model()))[0])


@pytest.mark.thorough
def test_rbe3_is_the_mean_and_adds_no_stiffness(body):
    extra = ["GRID,901,,.1,0.,0.", "RBE3,40,,901,123456,1.,123,401,403", ",501,503"]
    result = body(model(extra=extra))
    assert_close(values(result), values(body(model())), rtol=1e-9, atol=0)
    psi, x = result.structure()["psi"].detach(), result.mesh.nodes
    mean = result.mesh.node("rbe3_40")
    grids = [result.mesh.node(f"grid_{k}") for k in (401, 403, 501, 503)]
    # The center of the four grids lies at x = 0.075: their mean displacement is the average's motion there.
    at = psi[mean, :3] + torch.linalg.cross(psi[mean, 3:], (x[grids].mean(0) - x[mean])[:, None].expand(3, 4), dim=0)
    assert_close(at, psi[grids, :3].mean(0), rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_a_shell_of_metal_with_a_stack_beside_it(body):
    """Two properties are two parts; the angle of the metal is no design variable, and its extra mass counts."""
    text = model().replace("CQUAD4,1,7", "CQUAD4,1,8").replace("CQUAD4,2,7", "CQUAD4,2,8")
    extra = "MAT1,2,70.+9,,.3,2700.\nPSHELL,8,2,4.-3,2,,2,,1.5\nENDDATA"
    result = body(text.replace("ENDDATA", extra))
    assert [name for name, x in result.named_parameters() if x.requires_grad] == ["pcomp_7.angles"]
    assert result.pshell_8.layer_plies[0].density * 4e-3 == pytest.approx(2700 * 4e-3 + 1.5)
    both = float(result.structure()["mass"])
    assert both == pytest.approx(0.03 * 10 / 12 * 1586 * 4.5e-3 + 0.03 * 2 / 12 * (2700 * 4e-3 + 1.5))


@pytest.mark.thorough
def test_first_ply_failure_of_a_model_of_two_stacks(body):
    """Points run over both parts, by the cells of the mesh; the index is the largest of all."""
    text = model(support="").replace("CQUAD4,1,7", "CQUAD4,1,8").replace("CQUAD4,2,7", "CQUAD4,2,8")
    rod = body(text.replace("ENDDATA", "PCOMP,8\n,1,2.-3,0.,YES,1,2.-3,90.,YES\nENDDATA"), modes=2)
    ground, end = mbd.Ground(), rod.at("grid_2")
    system = mbd.System([rod], [mbd.Revolute(ground.at(*end.point.tolist()), end, axis="y")], gravity=(0, 0, -9.81))
    motion = mbd.simulate(system, 2e-3, steps=20).require_ok()
    plies = mbd.PlyHistory(motion, "plate")
    assert len(plies.points) == 2 * 2 * 2 + 2 * 10 * 3  # (faces, cells, layers) of both parts
    assert sorted(set(plies.points[:, 0].tolist())) == list(range(12))
    everywhere = plies.indices("max_stress")
    assert_close(mbd.PlyFailure("plate", "max_stress").values(motion), everywhere.amax(-1))
    assert float(everywhere.detach().max()) > 0


@pytest.mark.thorough
def test_materials_without_density(body):
    """`density` is that of materials without RHO, in SI units whatever the file has; others keep theirs."""
    text = model(millimeters=True)
    assert ",1.586e-09" in text
    with refused("MAT8 1 (model.bdf, line 3).RHO"):
        body(text.replace(",1.586e-09", ","), units="mm")
    assert_close(
        values(body(text.replace(",1.586e-09", ","), units="mm", density=1586.0)), by_hand(), rtol=1e-9, atol=0
    )
    assert_close(values(body(text, units="mm", density=1.0)), by_hand(), rtol=1e-9, atol=0)
    with refused("model.bdf.density", -1):
        body(text, units="mm", density=-1)


@pytest.mark.thorough
def test_shells_with_drilling(body):
    """CQUADR is the same element: every shell has drilling freedoms here."""
    assert_close(values(body(model().replace("CQUAD4", "CQUADR"))), by_hand(), rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_a_stack_of_numbered_plies(body):
    """A PCOMPG has a line for each ply, with its number."""
    own = "PCOMP,7,,,,TSAI\n,1,0.001,20.,YES,1,0.002,-50.,YES\n,1,0.0015,75.,YES"
    text = model().replace(own, "PCOMPG,7,,,,TSAI\n,11,1,.001,20.,YES\n,12,1,.002,-50.\n,13,1,.0015,75.")
    assert "PCOMPG" in text
    assert_close(values(body(text)), by_hand(), rtol=1e-9, atol=0)


def test_a_symmetric_stack_repeats_its_blank_fields(body):
    text = model().replace("PCOMP,7,,,,TSAI", "PCOMP,7,,,,TSAI,,,SYM").replace(",1,0.0015,75.,YES", ",,,75.,YES")
    result = body(text)
    assert result.laminate.symmetric
    assert result.laminate.thickness.tolist() == [1e-3, 2e-3, 2e-3]
    assert float(result.laminate.total_thickness) == pytest.approx(10e-3)


SECTIONS = {
    "PBARL": ["PBARL,5,2,,BAR", ",.01,.02"],
    "PBAR": ["PBAR,5,2,2.-4,6.66667-9,1.66667-9,4.578-9", ",", ",.83333,.83333"],
    "PBEAM": ["PBEAM,5,2,2.-4,6.66667-9,1.66667-9,0.,4.578-9", ",", ",NO,1.,2.-4,6.66667-9,1.66667-9,0.,4.578-9"],
}


@pytest.mark.parametrize("end", ["", "NO,1.,2.-4,6.-9,1.-9,0.,4.-9\n,\n,"])
def test_shear_factors_of_a_beam(end, body):
    """K1 and K2 stand after end B, or in its place; zero is rigid: a short cantilever, sheared along y more than along z."""
    lines = [
        "GRID,1,,0.,0.,0.",
        "GRID,2,,.01,0.,0.",
        "CBEAM,1,5,1,2,0.,1.,0.",
        "MAT1,2,70.+9,,.3,2700.",
        "SPC1,1,123456,1",
    ]
    result = body("\n".join([*lines, "PBEAM,5,2,2.-4,6.-9,1.-9,0.,4.-9", ",", f",{end}.25,0."]), modes=2)
    K = result.assembly.parts["pbeam_5"].section.stiffness()
    assert float(K[1, 1]) == pytest.approx(0.25 * 2e-4 * 70e9 / 2.6)
    assert float(K[2, 2]) > 1e5 * float(K[1, 1])


@pytest.mark.parametrize("section", SECTIONS)
def test_beams_of_bars(section, body):
    """A cantilever of ten bars: bending frequencies in both planes within 1 %, plane 1 along the orientation vector."""
    name = "CBEAM" if section == "PBEAM" else "CBAR"
    lines = [f"GRID,{k},,{0.06 * k},0.,0." for k in range(1, 12)]
    lines += [f"{name},{k},5,{k},{k + 1},0.,1.,1." for k in range(1, 11)]
    lines += [*SECTIONS[section], "MAT1,2,70.+9,,.3,2700.", "SPC1,1,123456,1"]
    result = body("\n".join(lines), modes=2)
    first = [1.8751**2 * h / math.sqrt(12) / 0.6**2 * math.sqrt(70e9 / 2700) for h in (0.01, 0.02)]
    assert values(result).sqrt().tolist() == pytest.approx(first, rel=0.01)
    psi = result.structure()["psi"].detach()[result.mesh.node("grid_11"), :3, 0]
    soft = torch.tensor([0.0, 1.0, -1.0], dtype=torch.float64) / math.sqrt(2)  # across the vector of plane 1
    assert abs(float(psi @ soft)) == pytest.approx(float(psi.norm()), rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("PBARL,5,2,,BAR", "PBARL,5,2,,DBOX", ["PBARL 5", "TYPE = 'DBOX'", "ROD, T, T1"]),
        (",0.,1.,1.", ",0.,1.,1.\n,37", ["CBAR 1", "pins '37'", "1 to 6"]),
        (",0.,1.,1.", ",0.,1.,1.,BGX", ["CBAR 1", "OFFT = 'BGX'"]),
        ("CBAR,1,5,1,2,0.,1.,1.", "CBAR,1,5,1,2,99", ["CBAR 1", "GRID 99 does not exist"]),
        ("MAT1,2,70.+9,,.3", "MAT1,2,70.+9,,", ["MAT1 2", "two of E, G, NU"]),
        ("PBARL,5,2,,BAR", "PBCOMP,5,2", ["CBAR 1", "property 5 does not exist"]),
        ("PBARL,5,2,,BAR\n,.01,.02", "PBEAM,5,2,2.-4,6.-9,1.-9,0.,4.-9\n,\n,NO,1.2,1.-4", ["PBEAM 5", "X/XB = 1.2"]),
        ("PBARL,5,2,,BAR\n,.01,.02", "PBEAML,5,2,,BAR\n,.01,.02,,OFF", ["PBEAML 5", "SO = 'OFF'"]),
    ],
)
def test_what_is_wrong_with_beams_is_named(old, new, words, body):
    text = "\n".join(
        ["GRID,1,,0.,0.,0.", "GRID,2,,1.,0.,0.", "CBAR,1,5,1,2,0.,1.,1.", *SECTIONS["PBARL"], "MAT1,2,70.+9,,.3,2700."]
    )
    assert old in text
    with pytest.raises(InputError) as error:
        body(text.replace(old, new), modes=1)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.thorough
def test_a_stiffened_plate(body):
    """Bars along the middle of the plate make it stiffer, and the body has both parts."""
    extra = [f"CBAR,{100 + i},5,{100 * i + 2},{100 * i + 102},0.,0.,1." for i in range(6)]
    extra += ["PBAR,5,2,1.-4,2.-8,1.-9,3.-9", "MAT1,2,70.+9,,.3,2700."]
    result = body(model(extra=extra))
    assert float(values(result)[0]) > 2 * float(values(body(model()))[0])
    assert float(result.structure()["mass"]) == pytest.approx(0.03 * 1586 * 4.5e-3 + 0.3 * 1e-4 * 2700)


@pytest.mark.thorough
def test_an_eccentric_stiffener(body):
    """A bar in its place by offsets, or on grids of its own there that rigid elements carry: the same modes."""
    section = ["PBARL,5,2,,BAR", ",.004,.02", "MAT1,2,70.+9,,.3,2700."]
    offset = [
        f"CBAR,{100 + i},5,{100 * i + 2},{100 * i + 102},0.,0.,1.\n,,,.0,.003,.012,0.,.003,.012" for i in range(6)
    ]
    own = [f"GRID,{900 + i},,{0.05 * i - 0.15!r},.003,.012" for i in range(7)]
    own += [f"RBE2,{700 + i},{100 * i + 2},123456,{900 + i}" for i in range(7)]
    own += [f"CBAR,{100 + i},5,{900 + i},{901 + i},0.,0.,1." for i in range(6)]
    result, expected = (values(body(model(extra=[*section, *extra]))) for extra in (offset, own))
    assert_close(result, expected, rtol=1e-8, atol=0)
    middle = [f"CBAR,{100 + i},5,{100 * i + 2},{100 * i + 102},0.,0.,1." for i in range(6)]
    assert float(result[0]) > 1.5 * float(values(body(model(extra=[*section, *middle])))[0])


@pytest.mark.thorough
def test_a_mechanism_from_a_file_has_gradients(body):
    """One line of an analyst's model moves and has sensitivities by its PCOMP angles."""
    rod = body(model(extra=RIGID_END, support=""), modes=2)
    ground = mbd.Ground()
    system = mbd.System(
        [rod], [mbd.Revolute(ground.at(*(rod.at("grid_2").point.tolist())), rod.at("grid_2"), axis="y")]
    )
    motion = mbd.simulate(system, 2e-3, steps=20, gradients="forward").require_ok()
    assert motion.dq_db.shape[-1] == 3
    assert motion.parameters[0] == "plate.laminate.angles[0]"


REPLACED = [
    ("CQUAD4,1,7", "CQUAD4,1,9", ["CQUAD4 1", "line 29", "property 9 does not exist"]),
    (",1,0.001,20.", ",5,0.001,20.", ["PCOMP 7", "material 5 does not exist"]),
    ("CQUAD4,1,7,1,", "CQUAD4,1,7,77,", ["CQUAD4 1", "GRID 77 does not exist"]),
    ("CQUAD4,1,7", "CQUAD8,1,7", ["CQUAD8 1", "cannot be read", "CTRIA3, CQUAD4"]),
    ("CQUAD4,2,7", "CQUAD4,1,7", ["CQUAD4 1", "number appears twice"]),
    ("PCOMP,7,,,,TSAI", "PCOMP,7,,,,TSAI,,,MEM", ["PCOMP 7", "LAM = 'MEM'", "SYM"]),
    (",1586.0", "", ["MAT8 1", "RHO = ''"]),
    (",.23,", ",9.,", ["MAT8 1", "nu12 = 9.0"]),
    ("GRID,1,,-0.15", "GRID,1,3,-0.15", ["GRID 1", "coordinate system 3 does not exist"]),
    ("ENDDATA", "SPOINT,950\nCELAS2,950,1.+5,1,1,950\nENDDATA", ["CELAS2 950", "grid 1 with a scalar point"]),
    ("ENDDATA", "RBE2,30,1,127,2\nENDDATA", ["RBE2 30", "CM = '127'"]),
    ("ENDDATA", "RBE2,30,1,123456,2\nRBE2,31,3,123456,2\nENDDATA", ["RBE2 31", "GRID 2 follows already by RBE2 30"]),
    ("ENDDATA", "GRID,1,,0.,0.,0.\nENDDATA", ["GRID 1", "appears twice"]),
    ("GRID,1,,-0.15,-0.05", "GRID,1,,-0.15,-0.0x", ["GRID 1", "X2 = '-0.0x'"]),
    ("GRID,101,", "GRID,101,,-.15,-.05,0.\n$", ["CQUAD4 1 ", "is collapsed"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "words"), REPLACED, ids=[new.split("\n")[0] for _, new, _ in REPLACED])
def test_what_is_wrong_is_named_by_card_and_line(old, new, words, body):
    text = model()
    assert old in text
    with pytest.raises(InputError) as error:
        body(text.replace(old, new, 1))
    assert all(word in str(error.value) for word in [*words, "model.bdf"])


def test_an_inverted_element_is_named_by_its_card(body):
    text = model()
    line = next(x for x in text.splitlines() if x.startswith("CQUAD4,1,"))
    grids = line.split(",")[3:7]
    with warned("CQUAD4 1 (model.bdf, line 29)", "opposite senses"):
        body(text.replace(",".join(grids), ",".join(grids[::-1]), 1))


@pytest.mark.thorough
def test_what_is_left_out_is_said(body):
    with warned("FORCE (2)", "LOAD (1)"):
        body(model(extra=["FORCE,1,601,0,1.,0.,0.,1.", "FORCE,1,602,0,1.,0.,0.,1.", "LOAD,2,1.,1.,1"]))
    with warned("3 grids", "components 3 by SPC1"):
        assert body(model(support="SPC1,1,3,{left}")).reference != [0, 1, 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body(model(extra=["PARAM,POST,-1"]))


@pytest.mark.thorough
def test_weight_in_place_of_mass(body):
    heavy = float(body(model()).structure()["mass"])
    assert float(body(model(extra=["PARAM,WTMASS,.5"])).structure()["mass"]) == pytest.approx(0.5 * heavy)


def test_units_that_look_wrong(body):
    """A file in mm, t, s read as m, kg, s: the message tells size and first frequency."""
    with warned("body 'plate'", "316 m", "'mm'"):
        body(model(millimeters=True))
    with refused("units", "inch"):
        body(model(), units="inch")

# ruff: noqa: F811 (fixtures)
"""Matrix files of other programs: the same numbers in every format; one wrong field is named by file and line."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from torch.testing import assert_close

import torchmbd as mbd
from tests.multibody.bodies.test_from_matrices import NODES, SETS, built, given, numbers  # noqa: F401
from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.extensions.matrices import read_matrix

A = np.array([[4.0, -1.5, 0.0, 2.0e-3], [-1.5, 5.0, 0.25, 0.0], [0.0, 0.25, 6.0, 0.0], [2.0e-3, 0.0, 0.0, 7.0]])
ROWS = [(11, 1), (11, 5), (20, 1), (20, 3)]  # node and direction of each row of A


def matrix_market(path):
    scipy.io.mmwrite(path, scipy.sparse.coo_array(A), symmetry="symmetric", precision=17)


def abaqus_labels(path):
    lines = [
        f"{ROWS[i][0]}, {ROWS[i][1]}, {ROWS[j][0]}, {ROWS[j][1]}, {A[i, j]:.16e}" for i, j in np.argwhere(np.tril(A))
    ]
    path.write_text("*MATRIX INPUT,NAME=K,TYPE=SYMMETRIC\n" + "\n".join(lines))


def abaqus_coordinate(path):
    path.write_text("\n".join(f"{i + 1} {j + 1} {A[i, j]:.16e}" for i, j in np.argwhere(A)))


def _op4(path, style, column):
    head = f"{4:8}{4 if style != 'big' else -4:8}{6:8}{2:8}{'KGG':8}1P,3E23.16\n"
    last = f"{5:8}{1:8}{1:8}\n{1.0:23.16E}\n"
    path.write_text(head + "".join(column(j) for j in range(4)) + last)


def _numbers(x):
    return "".join("".join(f"{v:23.16E}" for v in x[k : k + 3]) + "\n" for k in range(0, len(x), 3))


def op4_dense(path):
    def column(j):
        first, last = np.flatnonzero(A[:, j])[[0, -1]]
        return f"{j + 1:8}{first + 1:8}{2 * (last - first + 1):8}\n" + _numbers(A[first : last + 1, j])

    _op4(path, "dense", column)


def op4_small(path):
    def column(j):
        rows = np.flatnonzero(A[:, j])
        strings = "".join(f"{65536 * (2 + 1) + i + 1:8}\n" + _numbers(A[i : i + 1, j]) for i in rows)
        return f"{j + 1:8}{0:8}{3 * len(rows):8}\n" + strings

    _op4(path, "small", column)


def op4_big(path):
    def column(j):
        rows = np.flatnonzero(A[:, j])
        strings = "".join(f"{2 + 1:8}{i + 1:8}\n" + _numbers(A[i : i + 1, j]) for i in rows)
        return f"{j + 1:8}{0:8}{4 * len(rows):8}\n" + strings

    _op4(path, "big", column)


def dmig(path):
    cards = ["DMIG,KAAX,0,6,2,0"]
    for j in range(4):
        for i in range(j, 4):
            if A[i, j]:
                cards.append(f"DMIG*,KAAX,{ROWS[j][0]},{ROWS[j][1]},,*\n*,{ROWS[i][0]},{ROWS[i][1]},{A[i, j]:.9E}")
    path.write_text("BEGIN BULK\n" + "\n".join(cards) + "\nENDDATA\n")


@pytest.mark.parametrize(
    ("write", "name", "with_rows"),
    [
        (matrix_market, "a.mtx", False),
        (abaqus_labels, "a.mtx", True),
        (abaqus_coordinate, "a.mtx", False),
        (op4_dense, "a.op4", False),
        (op4_small, "a.op4", False),
        (op4_big, "a.op4", False),
        (dmig, "a.pch", True),
    ],
)
def test_the_same_matrix_in_every_format(write, name, with_rows, tmp_path):
    write(tmp_path / name)
    result = read_matrix(tmp_path / name)
    np.testing.assert_array_equal(result.matrix.toarray(), A)
    assert result.rows == (ROWS if with_rows else None)


def test_a_file_of_two_matrices(tmp_path):
    op4_dense(tmp_path / "k.op4")
    one = (tmp_path / "k.op4").read_text()
    other = one.replace("KGG", "MGG").replace("4.0000000000000000E+00", "9.0000000000000000E+00")
    (tmp_path / "both.op4").write_text(one + other)
    assert read_matrix(tmp_path / "both.op4", "K").matrix[0, 0] == 4.0
    assert read_matrix(tmp_path / "both.op4", "M").matrix[0, 0] == 9.0
    assert read_matrix(tmp_path / "both.op4", "KGG").matrix[0, 0] == 4.0
    with refused("both.op4"):
        read_matrix(tmp_path / "both.op4", "XX")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.mtx", "1 1 4.0\n1 2 x\n", "a.mtx, line 2: '1 2 x'"),
        ("a.mtx", "1 1 4.0\n1, 1, 1, 2, 5.0\n", "two kinds of lines"),
        ("a.mtx", "", "no entries"),
        ("a.mtx", "1 1000000000 4.0\n", "must be square, with at most 3000000 rows"),
        (
            "a.mtx",
            "%%MatrixMarket matrix coordinate real general\n2000000000 2000000000 1\n1 1 1.0\n",
            "at most 3000000",
        ),
        ("a.mtx", "%%MatrixMarket matrix coordinate complex general\n1 1 1\n1 1 1.0 2.0\n", "complex: must be real"),
        ("a.mtx", "%%MatrixMarket matrix coordinate real general\n2 2 5\n1 1 1.0\n", "a.mtx"),
        ("a.op4", f"{4:8}{9:8}{6:8}{2:8}KGG     1P,3E23.16\n", "line 1: a matrix of 9 x 4"),
        ("a.op4", f"{4:8}{4:8}{6:8}{4:8}KGG     1P,3E23.16\n", "type 4: must have type 1 or 2"),
        ("a.op4", "not a matrix\n", "not a header of an OP4 matrix"),
        ("a.op4", "\x18\0\0\0\4\0\0\0\4\0\0\0\6\0\0\0\2\0\0\0KGG     \x18\0\0\0", "Try: OP4 as text, not binary"),
        ("a.op4", f"{2:8}{2:8}{6:8}{2:8}KGG     1P,3E23.16\n{1:8}{7:8}{2:8}\n{1.0:23.16E}\n", "row 7, column 1"),
        ("a.op4", f"{2:8}{2:8}{6:8}{2:8}KGG     1P,3E23.16\n{1:8}{1:8}{2:8}\n{1.0:23.16E}\n", "ends in column 1 of 2"),
        ("a.op4", f"{2:8}{2:8}{6:8}{2:8}KGG     1P,3E23.16\n{1:8}{1:8}{2:8}\n 1.0X\n", "a.op4, line 3: '1.0X'"),
        (
            "a.op4",
            f"{2:8}{2:8}{6:8}{2:8}KGG     1P,3E23.16\n{1:8}{1:8}       y\n",
            "a.op4, line 2: 'y': must be whole",
        ),
        ("a.mtx", "%%MatrixMarket matrix coordinate real general\n3 3 1000000000000\n1 1 1.0\n", "entries in 72 bytes"),
        ("a.mtx", "%%MatrixMarket matrix array real general\n3000000 3000000\n1.0\n", "9000000000000 entries"),
        ("a.mtx", "1,1,1,1,4.0\n1,8,1,8,5.0\n", "node 1 has the direction 8: must be 1 to 6"),
        ("a.pch", "DMIG,KAAX,0,6,2,0\nDMIG,KAAX,1,-7,,1,-7,4.0\n", "node 1 has the direction -7"),
        ("a.pch", "DMIG,KAAX,1,1,,1,1,4.0\n", "comes later or never"),
        ("a.pch", "DMIG,KAAX,0,6,3,0\n", "and real"),
        ("a.pch", "GRID,1,,0.,0.,0.\n", "no DMIG matrix"),
        ("a.txt", "1 1 4.0\n", "its ending = '.txt'"),
    ],
)
def test_wrong_files_are_named(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as error:
        read_matrix(tmp_path / name)
    assert words in str(error.value), error.value


def test_a_half_of_mixed_triangles_is_the_whole_matrix(tmp_path):
    """IFO 6: each entry beside the diagonal stands once, above or below it."""
    lines = ["DMIG,KAAX,0,6,2,0"]
    for i, j in ((0, 0), (1, 0), (3, 0), (1, 1), (1, 2), (2, 2), (3, 3)):  # 10, 30 below the diagonal, 12 above
        lines.append(f"DMIG,KAAX,{ROWS[j][0]},{ROWS[j][1]},,{ROWS[i][0]},{ROWS[i][1]},{float(A[i, j])!r}")
    path = tmp_path / "k.pch"
    path.write_text("\n".join(lines))
    result = read_matrix(path)
    assert result.rows == ROWS
    np.testing.assert_array_equal(result.matrix.toarray(), A)


def test_a_file_that_does_not_exist():
    with refused("path", "none.mtx"):
        read_matrix("none.mtx")


@pytest.mark.parametrize("begin", ["BEGIN SUPER     111", "BEGIN SUPER=111"])
def test_the_punch_file_of_one_external_superelement(begin, tmp_path):
    """Nastran writes comments and BEGIN SUPER above its cards; generalized coordinates are scalar points."""
    file = tmp_path / "part.pch"
    cards = [
        "CORD2R *             701               0              0.              0.",
        "*                     0.              0.              0.              1.",
        "*                     1.              0.              0.",
        "GRID   *               7                              0.              0.",
        "*                     0.",
        "SPOINT,901",
        "DMIG,KAAX,0,6,2,0",
        "DMIG,KAAX,7,1,,7,1,4.",
        "DMIG,KAAX,901,0,,901,0,9.",
    ]
    file.write_text("\n".join(["$ STANDARD PUNCH (.PCH) FILE FOR EXTERNAL SUPERELEMENT 111", "$", begin, *cards, ""]))
    matrix = mbd.io.read_matrix(file)
    assert matrix.rows == [(7, 1), (901, 1)]
    assert matrix.matrix.toarray().tolist() == [[4.0, 0.0], [0.0, 9.0]]
    file.write_text("\n".join(["GRID,1,,0.,0.,0.", begin, *cards, ""]))
    with refused("part.pch, line 2"):
        mbd.io.read_matrix(file)


def test_a_matrix_is_not_refused_for_its_neighbor(tmp_path):
    """Complex and rectangular matrices beside it are refused where they are asked for; before and behind it."""
    one, two = "1.0000000000000000E+00", "2.0000000000000000E+00"
    real = "       2       2       6       2KGG     1P,3E23.16\n       1       1       2\n"
    real += f" {two}-{one}\n       2       1       2\n-{one} {two}\n       3       1       1\n 0.0000000000000000E+00\n"
    other = f"       1       1       6       4CPX     1P,3E23.16\n       1       1       2\n {one} {one}\n"
    other += "       2       1       1\n 0.0000000000000000E+00\n"
    for text in (real + other, other + real, other + real + other.replace("CPX", "CP2")):
        file = tmp_path / "two.op4"
        file.write_text(text)
        for name in ("K", "KGG"):
            assert read_matrix(file, name).matrix.toarray().tolist() == [[2.0, -1.0], [-1.0, 2.0]]
        with pytest.raises(InputError, match=r"two.op4, line \d: CPX has type 4: must have type 1 or 2, real"):
            read_matrix(file, "CPX")
    file = tmp_path / "two.dmig"
    file.write_text("DMIG,KX,0,6,1\nDMIG,KX,3,3,,3,3,100.\nDMIG,RX,0,2,1,,,,1\nDMIG,RX,1,,,3,3,1.\n")
    assert read_matrix(file, "K").matrix.toarray().tolist() == [[100.0]]
    with refused("DMIG RX (two.dmig, line 3).IFO", ANY, "2, 1"):
        read_matrix(file, "RX")


def test_matrices_that_were_saved_make_the_same_body(built, numbers, tmp_path):
    paths = built.save_matrices(tmp_path / "arm")
    assert [p.name for p in paths] == ["arm_M.mtx", "arm_K.mtx"]
    want, result = given(numbers).structure(), given([mbd.io.read_matrix(path) for path in paths]).structure()
    for key in ("mass", "S0", "P0", "S1", "C0", "C1", "Kr", "psi"):
        assert_close(result[key], want[key], rtol=1e-9, atol=1e-9 * float(want[key].abs().max()))


def test_labels_of_a_file_find_their_nodes(numbers, tmp_path):
    """Abaqus' rows by node label and direction, in any order."""

    def label(k):
        return f"{100 + 10 * (k // 6)}, {k % 6 + 1}"

    order = np.random.default_rng(1).permutation(42)
    for key, A in zip("MK", numbers, strict=True):
        coo = scipy.sparse.coo_array(A.toarray()[np.ix_(order, order)])
        rows = zip(order[coo.row], order[coo.col], coo.data, strict=True)
        text = "\n".join(f"{label(i)}, {label(j)}, {v:.17e}" for i, j, v in rows)
        (tmp_path / f"{key}.mtx").write_text(text)
    places = {100 + 10 * k: x for k, x in enumerate(NODES.tolist())}
    own = {"modes": 4, "reference": 0, "node_sets": SETS}
    result = mbd.FlexibleBody.from_matrices(
        "arm", *(mbd.io.read_matrix(tmp_path / f"{key}.mtx") for key in "MK"), places, **own
    )
    assert_close(result.structure()["Kr"], given(numbers).structure()["Kr"], rtol=1e-9, atol=1e-3)

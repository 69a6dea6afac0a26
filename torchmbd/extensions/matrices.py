"""Mass and stiffness matrices from files of other programs, as SciPy sparse matrices.

    Matrix Market       %%MatrixMarket matrix coordinate real symmetric         .mtx, .mm; read by SciPy
    Abaqus              *MATRIX OUTPUT: node, dof, node, dof, value (matrix input, labels) or row col value      .mtx
    Nastran OP4         text, real, dense or sparse, small or big                .op4
    Nastran DMIG        bulk data, real, square or symmetric                     .dmig, .pch, .bdf, .dat

Abaqus and DMIG name the node and direction of each row; the others count rows 1, 2, 3, ... Where a file has only one of each
two entries ij and ji, in either triangle, the other is its mirror image.
Source: MSC Nastran Quick Reference Guide (DMIG) and DMAP manual (OUTPUT4); Abaqus Analysis Guide, Generating matrices.
Checked in tests/extensions/test_matrices.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.cards import read_cards
from torchmbd.multibody.bodies.given_matrices import LabeledMatrix

__all__ = ["read_matrix"]

LARGEST = 3_000_000  # rows; a header with more is refused before memory is allocated


def read_matrix(path: str | Path, name: str | None = None) -> LabeledMatrix:
    """A mass or stiffness matrix of a file, for `FlexibleBody.from_matrices`.

    path   the file: .mtx, .mm, .op4, .dmig, .pch, .bdf, .dat
    name   of one of several matrices of the file, or how one name alone begins, such as "K"; None: the file has one
    Raises InputError that names file, line and value.

    >>> with open("K.mtx", "w") as file:
    ...     _ = file.write("%%MatrixMarket matrix coordinate real symmetric\\n2 2 3\\n1 1 4.0\\n2 1 -1.0\\n2 2 5.0\\n")
    >>> mbd.io.read_matrix("K.mtx").matrix.toarray().tolist()
    [[4.0, -1.0], [-1.0, 5.0]]
    """
    if not isinstance(path, (str, Path)) or not Path(path).is_file():
        raise InputError("path", str(path), "a matrix file that exists")
    if name is not None and not isinstance(name, str):
        raise InputError("name", name, "the name of a matrix of the file, or None")
    file = Path(path)
    try:
        matrices = _read(file)
    except (ValueError, OSError, IndexError, OverflowError) as error:
        raise (
            error
            if isinstance(error, InputError)
            else InputError("path", str(path), "a matrix file", noun=f"{file.name}:", state=f"{error}")
        ) from None
    names = [key for key in matrices if name is None or key.upper().startswith(name.upper())]
    if name in matrices:
        names = [name]
    if len(names) != 1:
        raise InputError(
            file.name,
            allowed="read with the name of one of them",
            state=f"has the matrices {list(matrices)}, name is {name!r}",
        )
    chosen = matrices[names[0]]
    if isinstance(chosen, InputError):
        raise chosen
    return chosen


def _read(file: Path) -> dict[str, LabeledMatrix | InputError]:
    """The matrices of a file by name; of one that is not real and square the reason, which counts where it is asked for."""
    suffix = file.suffix.lower()
    if suffix in (".mtx", ".mm"):
        with file.open(encoding="utf-8", errors="replace") as lines:
            if not lines.readline().startswith("%%MatrixMarket"):
                return {file.stem: _abaqus(file)}
        return {file.stem: LabeledMatrix(_matrix_market(file))}
    if suffix == ".op4":
        return dict(_op4(file))
    if suffix in (".dmig", ".pch", ".bdf", ".dat"):
        return _dmig(file)
    raise InputError("path", suffix, "one of .mtx, .mm, .op4, .dmig, .pch, .bdf, .dat", noun=f"{file.name}: its ending")


def _square(where: str, rows: int, columns: int) -> None:
    if rows != columns or not 0 < rows <= LARGEST:
        raise wrong_entry(where, f"a matrix of {rows} x {columns}", f"square, with at most {LARGEST} rows")


def _matrix_market(file: Path) -> scipy.sparse.csr_array:
    """Read a file whose entries are checked before: SciPy 1.17 ends the interpreter where a row or column is out of range."""
    rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(file)
    _square(file.name, rows, columns)
    if field not in ("real", "integer") or symmetry not in ("general", "symmetric"):
        raise wrong_entry(file.name, f"the matrix is {symmetry}, {field}", "real, general or symmetric")
    if 2 * entries > file.stat().st_size:
        raise wrong_entry(file.name, f"{entries} entries in {file.stat().st_size} bytes", "must have all of them")
    if layout == "array":
        return scipy.sparse.csr_array(scipy.io.mmread(file), dtype=np.float64)
    with file.open(encoding="utf-8", errors="replace") as handle:
        lines = (line for line in handle if line.strip() and not line.startswith("%"))
        next(lines)  # rows, columns, entries
        table = np.loadtxt(lines, ndmin=2)
    if table.shape != (entries, 3):
        raise wrong_entry(
            file.name, f"{table.shape[0]} lines of {table.shape[1]} numbers", f"must have {entries} lines of 3"
        )
    wrong = ((table[:, :2] < 1) | (table[:, :2] > rows) | (table[:, :2] % 1 != 0)).any(1)
    if wrong.any():
        at = int(wrong.argmax())
        raise wrong_entry(f"{file.name}, entry {at + 1}", f"row, column are {table[at, :2].tolist()}", f"1 to {rows}")
    i, j = table[:, :2].T.astype(int) - 1
    matrix = scipy.sparse.csr_array((table[:, 2], (i, j)), shape=(rows, rows))
    if symmetry == "symmetric":
        matrix = matrix + matrix.T - scipy.sparse.diags_array(matrix.diagonal())
    return scipy.sparse.csr_array(matrix)


def _mirrored(matrix: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return the whole matrix where only one of each two entries ij and ji may be given."""
    coo, n = matrix.tocoo(), np.int64(matrix.shape[0])  # pyright: ignore[reportOptionalSubscript]
    beside = (coo.row != coo.col) & (coo.data != 0.0)
    i, j = coo.row[beside], coo.col[beside]
    if np.isin(n * i + j, n * j + i).any():
        return matrix
    return scipy.sparse.csr_array(matrix + matrix.T - scipy.sparse.diags_array(matrix.diagonal()))


def _assembled(name: str, entries: list[tuple[tuple[int, int], tuple[int, int], float]]) -> LabeledMatrix:
    """Return the matrix of entries between (label, direction) pairs, rows in the order of labels."""
    rows = sorted({pair for i, j, _ in entries for pair in (i, j)})
    for label, direction in rows:
        if not 1 <= direction <= 6:
            raise wrong_entry(name, f"node {label} has the direction {direction}", "1 to 6", key="direction")
    index = {pair: k for k, pair in enumerate(rows)}
    i, j = ([index[pair] for pair in pairs] for pairs in zip(*((a, b) for a, b, _ in entries), strict=True))
    matrix = scipy.sparse.coo_array(([entry[2] for entry in entries], (i, j)), shape=(len(rows), len(rows)))
    return LabeledMatrix(_mirrored(scipy.sparse.csr_array(matrix)), rows)


def _abaqus(file: Path) -> LabeledMatrix:
    labelled, plain = [], []
    with file.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            words = line.replace(",", " ").split()
            if not words or line.startswith(("*", "%")):
                continue
            try:
                whole, value = [int(word) for word in words[:-1]], float(words[-1].upper().replace("D", "E"))
            except ValueError:
                whole, value = [], 0.0
            if len(whole) == 4:
                labelled.append(((whole[0], whole[1]), (whole[2], whole[3]), value))
            elif len(whole) == 2 and min(whole) > 0:
                plain.append((*whole, value))
            else:
                raise wrong_entry(
                    f"{file.name}, line {number}",
                    f"{line.strip()[:60]!r}",
                    "must have node, dof, node, dof, value, or row, column, value",
                )
    if bool(labelled) == bool(plain):
        raise InputError(
            file.name,
            allowed="must have one kind of lines",
            state=f"has {('two kinds of lines' if plain else 'no entries')}",
        )
    if labelled:
        return _assembled(file.name, labelled)
    size = max(max(i, j) for i, j, _ in plain)
    _square(file.name, size, size)
    i, j, values = (np.array(column) for column in zip(*plain, strict=True))
    return LabeledMatrix(_mirrored(scipy.sparse.csr_array((values, (i - 1, j - 1)), shape=(size, size))))


_FORMAT = re.compile(r"(\d*)[ED](\d+)\.(\d+)", re.IGNORECASE)


def _op4(file: Path) -> Iterator[tuple[str, LabeledMatrix | InputError]]:
    with file.open(encoding="ascii", errors="replace") as handle:
        lines = enumerate(handle, start=1)
        for number, head in lines:
            if not head.strip():
                continue
            where = f"{file.name}, line {number}"
            try:
                columns, rows, _, kind = (int(head[8 * k : 8 * k + 8]) for k in range(4))
            except ValueError:
                raise wrong_entry(
                    where, f"{head.strip()[:60]!r} is not a header of an OP4 matrix", hint="OP4 as text, not binary"
                ) from None
            name, style = head[32:40].strip(), _FORMAT.search(head[40:])
            try:
                if kind not in (1, 2):
                    raise InputError(
                        (str(where), name),
                        allowed="must have type 1 or 2, real",
                        noun=f"{where}: {name}",
                        state=f"has type {kind}",
                    )
                _square(where, abs(rows), columns)
            except InputError as error:
                _skip_columns(lines, columns)
                yield name, error
                continue
            width = max(int(style.group(2)), 1) if style else 16
            yield name, LabeledMatrix(_op4_columns(file.name, lines, columns, width))


def _skip_columns(lines: Iterator[tuple[int, str]], columns: int) -> None:
    """Read on to the end of a matrix: the number after its last column."""
    for _, line in lines:
        words = [] if "." in line else line.split()
        if len(words) == 3 and words[0].isdigit() and int(words[0]) > columns:
            next(lines, None)
            return


def _number(where: str, text: str, kind: type) -> Any:
    """Read a number of a line; Fortran writes 1D0."""
    try:
        return kind(text.upper().replace("D", "E"))
    except ValueError:
        raise wrong_entry(where, f"{text.strip()[:40]!r}", f"{('whole ' if kind is int else '')}numbers") from None


def _op4_columns(name: str, lines: Iterator[tuple[int, str]], size: int, width: int) -> scipy.sparse.csr_array:
    i: list[int] = []
    j: list[int] = []
    values: list[float] = []
    column = row = 0
    for number, line in lines:
        if "." in line:
            text = line.rstrip("\n").rstrip()
            for start in range(0, len(text), width):
                values.append(_number(f"{name}, line {number}", text[start : start + width], float))
                i.append(row - 1)
                j.append(column - 1)
                row += 1
            if not (1 <= column <= size and row - 1 <= size and i[-1] >= 0):
                raise wrong_entry(f"{name}, line {number}", f"row {row - 1}, column {column}", f"1 to {size}")
            continue
        words = [_number(f"{name}, line {number}", word, int) for word in line.split()]
        if len(words) == 3:
            column, row = words[0], words[1]
            if column > size:
                next(lines, None)  # the number after the last column
                break
        elif len(words) == 2:  # big: length, row
            row = words[1]
        elif len(words) == 1:  # small: 65536 (length + 1) + row
            row = words[0] % 65536
    if column <= size:
        raise InputError(
            (name,),
            allowed=f"must have all columns, and then the column number {size + 1}",
            state=f"ends in column {column} of {size}",
        )
    return scipy.sparse.csr_array((np.array(values), (np.array(i, int), np.array(j, int))), shape=(size, size))


def _dmig(file: Path) -> dict[str, LabeledMatrix | InputError]:
    refused: dict[str, InputError] = {}
    entries: dict[str, list[tuple[tuple[int, int], tuple[int, int], float]]] = {}
    for card in read_cards(file):
        if card.name != "DMIG":
            continue
        name = card.text(1)
        if card.text(2) == "0":
            entries[name] = []
            if card.integer(3, "IFO") not in (1, 6) or card.integer(4, "TIN", 1) not in (1, 2):
                refused[name] = wrong_entry(
                    card, f"IFO, TIN are {card.text(3)}, {card.text(4)}", "1 or 6, and real", key="IFO"
                )
            continue
        if name in refused:
            continue
        if name not in entries:
            raise wrong_entry(card, "the card of its header (second field 0) comes later or never")
        column = card.integer(2, "GJ"), card.integer(3, "CJ", 0) or 1
        for start in range(5, len(card.fields) + 1, 4):
            if card.text(start):
                row = card.integer(start, "G"), card.integer(start + 1, "C", 0) or 1
                entries[name].append((row, column, card.real(start + 2, "A")))
    matrices = refused | {name: _assembled(file.name, terms) for name, terms in entries.items() if terms}
    if not matrices:
        raise InputError(file.name, allowed="a file with at least one DMIG matrix", state="has no DMIG matrix")
    return matrices

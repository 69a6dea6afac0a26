"""Small Nastran models written as text, in any units: what the tests of the reader share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

MAT8 = "MAT8,1,{E1},{E2},.23,{G},{G},{G},{rho}\n,,,,{Xt},{Xt},{Yt},{Yc},{S}"
PCOMP = "PCOMP,7,,,,TSAI\n,1,{a},20.,YES,1,{b},-50.,YES\n,1,{c},75.,YES"


def model(
    cells: tuple[int, int] = (6, 2),
    millimeters: bool = False,
    corners: Callable[[int, int, int, int], Sequence[int]] = lambda a, b, c, d: (a, b, c, d),
    theta: str = "0.",
    triangles: bool = False,
    extra: Sequence[str] = (),
    support: str = "SPC1,1,123456,{left}",
) -> str:
    """A clamped carbon plate of 0.3 x 0.1 m, 20/-50/75 degrees; grid numbers are 100 i + j + 1."""
    L, stress, rho = (1e3, 1e6, 1e12) if millimeters else (1.0, 1.0, 1.0)
    nx, ny = cells
    lines = ["$ made by tests/extensions/nastran/bdf_models.py", "BEGIN BULK"]
    numbers = {"E1": 128e9, "E2": 10.1e9, "G": 5.36e9, "Xt": 1.5e9, "Yt": 4e7, "Yc": 2.46e8, "S": 6.8e7}
    lines.append(MAT8.format(rho=1586.0 / rho, **{key: x / stress for key, x in numbers.items()}))
    lines.append(PCOMP.format(a=1e-3 * L, b=2e-3 * L, c=1.5e-3 * L))
    for i in range(nx + 1):
        for j in range(ny + 1):
            x, y = L * (0.3 * i / nx - 0.15), L * (0.1 * j / ny - 0.05)
            lines.append(f"GRID,{100 * i + j + 1},,{x!r},{y!r},0.")
    element = 1
    for i in range(nx):
        for j in range(ny):
            a, b, c, d = (100 * k + m + 1 for k, m in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
            cuts = [(a, b, c), (a, c, d)] if (i + j) % 2 == 0 else [(a, b, d), (b, c, d)]
            for grids in cuts if triangles else [corners(a, b, c, d)]:
                name = "CTRIA3" if triangles else "CQUAD4"
                lines.append(f"{name},{element},7,{','.join(map(str, grids))},{theta}")
                element += 1
    left = ",".join(str(j + 1) for j in range(ny + 1))
    return "\n".join([*lines, *([support.format(left=left)] if support else []), *extra, "ENDDATA"]) + "\n"

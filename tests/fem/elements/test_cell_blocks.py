"""Sums of the numbers of cells, against matrices of cells that are added one after another."""

import pytest
import torch

from torchmbd.fem.elements.cell_blocks import CellBlocks
from torchmbd.math.linear_map import apply_linear

TRIANGLES, QUADS = torch.tensor([[0, 1, 4], [4, 3, 0]]), torch.tensor([[1, 2, 5, 4]])
NODES = 6


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize("entries", [None, [7, 300, 7, 12]])
def test_entries_are_sums_over_cells(entries):
    """Two triangles of one variant and a quadrilateral; also chosen entries, one of them twice."""
    blocks = CellBlocks([TRIANGLES, QUADS], NODES)
    tables = []
    for f in (18, 24):
        place = torch.zeros(f, f, dtype=torch.long)
        i, j = torch.triu_indices(f, f)
        place[i, j] = torch.arange(len(i))
        tables.append(place.maximum(place.mT))
    size = 171 + 300
    numbers = torch.randn(2, size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    K = torch.zeros(2, 6 * NODES, 6 * NODES, dtype=torch.float64)
    for corners, table, first in ((TRIANGLES, tables[0], 0), (QUADS, tables[1], 171)):
        for cell in corners:
            freedoms = (6 * cell[:, None] + torch.arange(6)).flatten()
            K[:, freedoms[:, None], freedoms] += numbers[:, first + table]
    pattern = blocks.pattern
    chosen = None if entries is None else torch.tensor(entries)
    first = [torch.zeros(2, dtype=torch.long), torch.tensor([171])]
    values = apply_linear(blocks.sums(first, tables, size, chosen), numbers)
    expected = K[:, pattern.rows, pattern.cols]
    torch.testing.assert_close(values, expected if chosen is None else expected[:, chosen], rtol=1e-14, atol=1e-14)
    assert torch.equal((K[0] != 0.0).nonzero(), torch.stack([pattern.rows, pattern.cols], 1))

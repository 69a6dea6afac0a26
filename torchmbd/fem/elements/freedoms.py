"""Free degrees of freedom of a body, and the map from them to all degrees of freedom: held nodes, links, mean motions.

    u = T u_free        u: all degrees of freedom of all nodes [6 n],  T: sparse, constant

held node     u = 0; so have single degrees of freedom without stiffness and mass
link          degrees of freedom that follow those of other nodes: rigid links, averages, combinations (links.py)
mean motion   y = B u of several nodes, six free degrees of freedom of their own; six of the nodes' follow: u_d = B_d^-1 (y -
B_r u_r)

So the values of K_free = T' K T are linear in those of K; `reduced` finds their map once per mesh.
Checked in tests/fem/elements/test_freedoms.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import scipy.linalg
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements.links import Follower, check_links, link_entries
from torchmbd.math.sparse import Pattern


@dataclass(frozen=True, eq=False)
class MeanMotion:
    """Six degrees of freedom, the mean motion y = matrix u of the degrees of freedom u of some nodes [6, 6 nodes]."""

    nodes: tuple[int, ...]
    matrix: Float[Tensor, "6 k"]


class ReducedEntries(NamedTuple):
    """Entries of T' K T on its pattern: values[position] += factor * values_of_K[source].

    position and factor are None where T only selects: values = values_of_K[source].
    """

    pattern: Pattern
    source: Int[Tensor, " terms"]
    position: Int[Tensor, " terms"] | None
    factor: Float[Tensor, " terms"] | None

    def at(self, place: Int[Tensor, " nnz"], pattern: Pattern) -> ReducedEntries:
        """The same sums in a larger pattern, which has entry k at place[k]."""
        position = place if self.position is None else place[self.position]
        return ReducedEntries(pattern, self.source, position, self.factor)

    def values(self, at_source: Float[Tensor, "*lanes terms"]) -> Float[Tensor, "*lanes nnz"]:
        """Values of T' K T from the values of K at `source`."""
        if self.position is None:
            return at_source
        terms = at_source if self.factor is None else at_source * self.factor
        return terms.new_zeros(*terms.shape[:-1], self.pattern.nnz).index_add(-1, self.position, terms)


class Freedoms:
    """The free degrees of freedom of the nodes x [n, 3] and the map T; see the module header.

    free                number 6 * node + i of each free degree of freedom [N], ascending; mean motions are nodes after the
                        others
    rows, cols, factor  the entries of T, sorted by rows
    plain               whether T only selects: no links
    absent              degrees of freedom that are left out
    """

    def __init__(
        self,
        x: Float[Tensor, "n 3"],
        held: Sequence[int] = (),
        links: Sequence[Follower] = (),
        absent: Int[Tensor, " k"] | None = None,
        means: Sequence[MeanMotion] = (),
    ) -> None:
        self.nodes = len(x)
        check_links(self.nodes, list(held), links)
        _check_means(list(held), links, means)
        bound = torch.zeros(self.nodes + len(means), dtype=torch.bool)
        bound[torch.tensor(list(held), dtype=torch.long)] = True
        bound = bound.repeat_interleave(6)
        bound[torch.tensor([6 * link.node + i for link in links for i in link.components], dtype=torch.long)] = True
        self.absent = torch.zeros(0, dtype=torch.long) if absent is None else absent
        bound[self.absent] = True
        following = [_following(x, mean, bound) for mean in means]
        bound[torch.tensor([f for led, _ in following for f in led.tolist()], dtype=torch.long)] = True
        self.free = torch.nonzero(~bound)[:, 0]
        self.plain = not links and not means
        column = torch.full((6 * (self.nodes + len(means)),), -1, dtype=torch.long)
        column[self.free] = torch.arange(len(self.free))
        node_freedoms = self.free[self.free < 6 * self.nodes]
        rows, cols, factor = (
            [node_freedoms],
            [torch.arange(len(node_freedoms))],
            [torch.ones(len(node_freedoms), dtype=x.dtype)],
        )
        led, source, link_factor = link_entries(x, links)
        kept = column[source] >= 0  # what follows a held node stands still
        rows.append(led[kept])
        cols.append(column[source[kept]])
        factor.append(link_factor[kept])
        for j, (mean, (led, inverse)) in enumerate(zip(means, following, strict=True)):
            others = _freedoms(mean.nodes)
            kept = column[others] >= 0
            block = torch.cat([inverse, -inverse @ mean.matrix[:, kept]], 1)
            source = torch.cat([column[6 * (self.nodes + j) + torch.arange(6)], column[others[kept]]])
            i, k = torch.nonzero(block, as_tuple=True)
            rows.append(led[i])
            cols.append(source[k])
            factor.append(block[i, k])
        order = torch.argsort(torch.cat(rows), stable=True)
        self.rows, self.cols, self.factor = (torch.cat(part)[order] for part in (rows, cols, factor))

    def reduced(self, pattern: Pattern) -> ReducedEntries:
        """Return the entries of T' K T for K on a pattern."""
        if self.plain:
            return ReducedEntries(*pattern.restrict(self.free), None, None)
        count = torch.bincount(self.rows, minlength=6 * self.nodes)
        first = count.cumsum(0) - count
        rows, cols = pattern.rows, pattern.cols
        pairs = count[rows] * count[cols]
        source = torch.repeat_interleave(pairs)
        within = torch.arange(len(source)) - (pairs.cumsum(0) - pairs)[source]
        r, c = rows[source], cols[source]
        row_entry = first[r] + torch.div(within, count[c], rounding_mode="floor")
        col_entry = first[c] + within % count[c]
        small, position = Pattern.gather(self.cols[row_entry], self.cols[col_entry], len(self.free))
        return ReducedEntries(small, source, position, self.factor[row_entry] * self.factor[col_entry])

    def expand(self, vectors: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes n 6 k"]:
        """Return T times columns: the motion of all nodes."""
        full = vectors.new_zeros(*vectors.shape[:-2], 6 * self.nodes, vectors.shape[-1])
        if self.plain:
            full = full.index_copy(-2, self.free, vectors)
        else:
            full = full.index_add(-2, self.rows, vectors[..., self.cols, :] * self.factor[:, None])
        return full.unflatten(-2, (self.nodes, 6))

    def gathered(self, forces: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes N k"]:
        """Return T' times columns: forces and moments on all nodes, as forces of the free degrees of freedom."""
        flat = forces.flatten(-3, -2)
        if self.plain:
            return flat[..., self.free, :]
        none = flat.new_zeros(*flat.shape[:-2], len(self.free), flat.shape[-1])
        return none.index_add(-2, self.cols, flat[..., self.rows, :] * self.factor[:, None])


def _freedoms(nodes: Sequence[int]) -> Tensor:
    """All degrees of freedom of nodes, in their order."""
    return (6 * torch.tensor(nodes)[:, None] + torch.arange(6)).flatten()


def _following(x: Tensor, mean: MeanMotion, bound: Tensor) -> tuple[Tensor, Tensor]:
    """The six degrees of freedom that follow the mean motion, the best conditioned, and the inverse of their columns."""
    freedoms, B = _freedoms(mean.nodes), mean.matrix
    places = x[list(mean.nodes)]
    size = float((places - places.mean(0)).norm(dim=1).max())
    missing = bound[freedoms] & (B != 0.0).any(0)
    if bool(missing.any()):
        raise InputError(
            "means",
            list(mean.nodes),
            "must not lie on a line",
            noun=f"nodes {list(mean.nodes)} of a mean motion",
            state="lie on a line and have no rotations, so that the rotation about this line is unknown",
        )
    scale = torch.tensor([1.0, 1.0, 1.0, size, size, size], dtype=x.dtype)
    scaled = scale[:, None] * B / scale.repeat(len(mean.nodes))
    _, R, order = scipy.linalg.qr(scaled.numpy(), mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
    assert abs(R[5, 5]) > 0.0  # the mean motion of a rigid motion is that motion: B has rank six
    led = torch.from_numpy(order[:6].astype("int64"))
    return freedoms[led], torch.linalg.inv(B[:, led])


def _check_means(held: list[int], links: Sequence[Follower], means: Sequence[MeanMotion]) -> None:
    taken = dict.fromkeys(held, "is held")
    for link in links:
        taken |= dict.fromkeys((link.node, *link.nodes), "is linked to others")
    for mean in means:
        for k in mean.nodes:
            if k in taken:
                raise InputError(
                    ("means", k),
                    allowed="in one mean motion, without supports and links",
                    noun=f"node {k} of a mean motion",
                    state=taken[k],
                )
            taken[k] = "is in another mean motion"

"""Which freedoms of a body are free, and how the others follow: held nodes, rigid links, averages.

    u = T u_free        u: all freedoms of all nodes [6 n],  T: sparse, constant

held node     u = 0; single freedoms that have neither stiffness nor mass, too
rigid link    u_s = u_m + phi_m x d,  phi_s = phi_m       node s follows node m, d from m to s        (RBE2)
              or only some of the six components: a ball joint has the first three
average       the rigid motion that fits weighted nodes best, in the sense of least squares           (RBE3)
combination   u_i of one node is the weighted sum of single freedoms of others                        (MPC)
mean motion   y = B u of several nodes, six free freedoms of their own; six of the nodes' follow: u_d = B_d^-1 (y - B_r u_r)

So K_free = T' K T has values that are linear in those of K: `reduced` tells how, once per mesh.
Checked in tests/fem/elements/test_freedoms.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import scipy.linalg
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.sparse import Pattern

#: Freedoms that follow, those that lead them, and factors.
Entries: TypeAlias = tuple[Tensor, Tensor, Tensor]
ALL = (0, 1, 2, 3, 4, 5)


@dataclass(frozen=True)
class RigidLink:
    """Node `node` moves with node `leader` as parts of one rigid body, in `components` 0 to 5 (ux uy uz, phi_x phi_y phi_z)."""

    node: int
    leader: int
    components: tuple[int, ...] = ALL

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        return _entries(self.node, self.components, [(self.leader, _rigid(x[self.node] - x[self.leader]))])

    @property
    def nodes(self) -> tuple[int, ...]:
        return (self.leader,)


@dataclass(frozen=True)
class Average:
    """Node `node` carries the mean motion of other nodes, with weights, in `components`."""

    node: int
    nodes: tuple[int, ...]
    weights: tuple[float, ...]
    components: tuple[int, ...] = ALL

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        return _entries(self.node, self.components, _mean(x, self))


@dataclass(frozen=True)
class Combination:
    """Component `component` of `node` is the sum of factor * component of node over `terms` (node, component, factor)."""

    node: int
    component: int
    terms: tuple[tuple[int, int, float], ...]

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        source = torch.tensor([6 * node + i for node, i, _ in self.terms], dtype=torch.long)
        factor = torch.tensor([a for *_, a in self.terms], dtype=x.dtype)
        return torch.full_like(source, 6 * self.node + self.component), source, factor

    @property
    def components(self) -> tuple[int, ...]:
        return (self.component,)

    @property
    def nodes(self) -> tuple[int, ...]:
        return tuple(node for node, *_ in self.terms)


#: What makes freedoms of a node follow others.
Follower: TypeAlias = RigidLink | Average | Combination


@dataclass(frozen=True, eq=False)
class MeanMotion:
    """Six freedoms, the mean motion y = matrix u of the freedoms u of some nodes [6, 6 nodes]."""

    nodes: tuple[int, ...]
    matrix: Float[Tensor, "6 k"]


class Freedoms:
    """The free freedoms of the nodes x [n, 3] and the map T; see the module header.

    free                freedom number 6 * node + i of each free freedom [N], ascending; mean motions are nodes after the others
    rows, cols, factor  the entries of T, sorted by rows
    plain               whether T only selects: no links
    absent              freedoms that are left out
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
        _check(self.nodes, list(held), links)
        _check_means(list(held), links, means)
        entries = [link.entries(x) for link in links]
        _check_chains(links, entries)
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
        own = self.free[self.free < 6 * self.nodes]
        rows, cols, factor = [own], [torch.arange(len(own))], [torch.ones(len(own), dtype=x.dtype)]
        for led, source, own_factor in entries:
            target = column[source]
            kept = target >= 0  # what follows a held node stands still
            rows.append(led[kept])
            cols.append(target[kept])
            factor.append(own_factor[kept])
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

    def reduced(self, pattern: Pattern) -> tuple[Pattern, Tensor, Tensor, Tensor]:
        """The pattern of T' K T, and (source, position, factor): values[position] sum up factor * values_of_K[source]."""
        if self.plain:
            small, source = pattern.restrict(self.free)
            return small, source, torch.arange(small.nnz), self.factor.new_ones(small.nnz)
        count = torch.bincount(self.rows, minlength=6 * self.nodes)
        first = count.cumsum(0) - count
        pairs = count[pattern.rows] * count[pattern.cols]
        source = torch.repeat_interleave(pairs)
        within = torch.arange(len(source)) - (pairs.cumsum(0) - pairs)[source]
        r, c = pattern.rows[source], pattern.cols[source]
        left = first[r] + torch.div(within, count[c], rounding_mode="floor")
        right = first[c] + within % count[c]
        small, position = Pattern.gather(self.cols[left], self.cols[right], len(self.free))
        return small, source, position, self.factor[left] * self.factor[right]

    def expand(self, vectors: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes n 6 k"]:
        """Return T times columns: the motion of all nodes."""
        full = vectors.new_zeros(*vectors.shape[:-2], 6 * self.nodes, vectors.shape[-1])
        if self.plain:
            full = full.index_copy(-2, self.free, vectors)
        else:
            full = full.index_add(-2, self.rows, vectors[..., self.cols, :] * self.factor[:, None])
        return full.unflatten(-2, (self.nodes, 6))

    def gathered(self, forces: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes N k"]:
        """Return T' times columns: forces and moments on all nodes, as forces of the free freedoms."""
        flat = forces.flatten(-3, -2)
        if self.plain:
            return flat[..., self.free, :]
        none = flat.new_zeros(*flat.shape[:-2], len(self.free), flat.shape[-1])
        return none.index_add(-2, self.cols, flat[..., self.rows, :] * self.factor[:, None])


def _entries(node: int, components: tuple[int, ...], blocks: list[tuple[int, Tensor]]) -> Entries:
    """Rows `components` of the blocks [6, 6] (leader, block), without zeros."""
    chosen = torch.tensor(components, dtype=torch.long)
    led, source, factor = [], [], []
    for leader, block in blocks:
        i, j = torch.nonzero(block[chosen], as_tuple=True)
        led.append(6 * node + chosen[i])
        source.append(6 * leader + j)
        factor.append(block[chosen][i, j])
    return torch.cat(led), torch.cat(source), torch.cat(factor)


def _rigid(d: Tensor) -> Float[Tensor, "6 6"]:
    """Motion at d from a point, from the motion of the point: u + phi x d, phi."""
    block = torch.eye(6, dtype=d.dtype)
    block[:3, 3:] = -_cross(d)
    return block


def _mean(x: Tensor, link: Average) -> list[tuple[int, Tensor]]:
    """Blocks of the rigid motion at the node that fits the displacements of the others best."""
    at, w = x[link.node], x.new_tensor(link.weights) / sum(link.weights)
    fields = torch.stack([_rigid(x[node] - at)[:3] for node in link.nodes])  # displacement of each for a rigid motion
    normal = torch.einsum("k,kij,kil->jl", w, fields, fields)
    size = fields[..., 3:].abs().amax()
    scale = torch.cat([x.new_ones(3), (1.0 / size).repeat(3)]) if size > 0 else x.new_ones(6)
    values = torch.linalg.eigvalsh(normal * scale * scale[:, None])
    if float(values[0]) < 1e-10 * float(values[-1]):
        raise InputError(
            f"average at node {link.node}: nodes {list(link.nodes)} lie on one line, "
            "so they tell no rotation about it; allowed: nodes that span a plane"
        )
    inverse = torch.linalg.inv(normal)
    blocks = []
    for weight, node, field in zip(w, link.nodes, fields, strict=True):
        block = x.new_zeros(6, 6)
        block[:, :3] = weight * inverse @ field.T
        blocks.append((node, block))
    return blocks


def _cross(d: Tensor) -> Tensor:
    zero = d.new_zeros(())
    return torch.stack([zero, -d[2], d[1], d[2], zero, -d[0], -d[1], d[0], zero]).reshape(3, 3)


def _freedoms(nodes: Sequence[int]) -> Tensor:
    """All freedoms of nodes, in their order."""
    return (6 * torch.tensor(nodes)[:, None] + torch.arange(6)).flatten()


def _following(x: Tensor, mean: MeanMotion, bound: Tensor) -> tuple[Tensor, Tensor]:
    """The six freedoms that follow the mean motion, the best conditioned, and the inverse of their columns."""
    freedoms, B = _freedoms(mean.nodes), mean.matrix
    own = x[list(mean.nodes)]
    size = float((own - own.mean(0)).norm(dim=1).max())
    missing = bound[freedoms] & (B != 0.0).any(0)
    if bool(missing.any()):
        raise InputError(
            f"the mean motion of nodes {list(mean.nodes)} needs the rotations of nodes that have none; allowed: nodes that are "
            "not on a line"
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
                    f"node {k} of a mean motion {taken[k]}; allowed: nodes that are neither held nor linked"
                )
            taken[k] = "is in another mean motion"


def _check(n: int, held: list[int], links: Sequence[Follower]) -> None:
    for k in (*held, *(k for link in links for k in (link.node, *link.nodes))):
        if not 0 <= k < n:
            raise InputError(f"a link or a held node is {k}; allowed: 0 to {n - 1}")
    taken: set[int] = set()
    for link in links:
        k, own = link.node, link.components
        if not own or not set(own) <= set(ALL) or len(set(own)) < len(own):
            raise InputError(f"components of the link of node {k} are {own}; allowed: different ones of 0 to 5")
        again = [i for i in own if 6 * k + i in taken]
        if again:
            raise InputError(f"components {again} of node {k} follow by 2 links; allowed: one")
        taken |= {6 * k + i for i in own}
        if k in held:
            raise InputError(
                f"node {k} is held and follows other nodes by a link; allowed: hold the node that leads it"
            )


def _check_chains(links: Sequence[Follower], entries: Sequence[Entries]) -> None:
    following = {6 * link.node + i for link in links for i in link.components}
    for _, source, _ in entries:
        for f in source.tolist():
            if f in following:
                raise InputError(
                    f"component {f % 6} of node {f // 6} follows other nodes and leads one; allowed: no chains of links"
                )

"""A batch of sets in the solvers' format: flattened, scaled, on the CPU, with the box among the rows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from constraints.base import ExplicitSet
from constraints.errors import EmptySetError, SampleName, name_samples, require
from constraints.numerics import one_where_zero, times

# A set is empty if its constraints miss each other by more than this. A smaller gap is rounding.
EMPTY = 1e-8
# A set whose deepest point is no deeper than this has no interior.
NO_INTERIOR = 1e-9


@dataclass(frozen=True)
class ScaledSets:
    """n sets: rows (n, m, d) @ a <= bounds (n, m), and k ellipses (a - center)' matrix (a - center) <= 1.

    Rows have unit norm or are 0, and the last 2 d are the box's. `root` is the square root of an ellipse's bound after
    scaling to tr Q = d. `name` names a sample in messages.
    """

    rows: Tensor
    bounds: Tensor
    matrix: Tensor  # (n, k, d, d)
    center: Tensor  # (n, k, d)
    root: Tensor  # (n, k)
    name: SampleName

    @property
    def dim(self) -> int:
        """d."""
        return self.rows.shape[-1]

    @property
    def given_rows(self) -> int:
        """The number of rows without the box's."""
        return self.rows.shape[1] - 2 * self.dim

    @property
    def given(self) -> Tensor:
        """Which rows (m,) are not the box's."""
        return torch.arange(self.rows.shape[1], device=self.rows.device) < self.given_rows

    @property
    def curved(self) -> bool:
        """Whether there are ellipses."""
        return self.matrix.shape[1] > 0

    @property
    def solid(self) -> Tensor:
        """Which rows (n, m) are not 0."""
        return (self.rows != 0.0).any(-1)

    def __getitem__(self, index: Tensor) -> ScaledSets:
        return ScaledSets(
            self.rows[index],
            self.bounds[index],
            self.matrix[index],
            self.center[index],
            self.root[index],
            self.name.part(index.tolist()),
        )

    def detach(self) -> ScaledSets:
        """The sets without the graph of their coefficients."""
        matrix, center, root = self.matrix.detach(), self.center.detach(), self.root.detach()
        return ScaledSets(self.rows.detach(), self.bounds.detach(), matrix, center, root, self.name)

    def inner(self, depth: Tensor) -> ScaledSets:
        """The subsets of points that are at least this deep (n,), as measured by the method `depth`."""
        distance = depth.unsqueeze(-1)
        matrix = self.matrix / (1.0 - distance / self.root).square()[..., None, None]
        return replace(self, bounds=self.bounds - distance * self.solid, matrix=matrix, root=self.root - distance)

    def ellipse_values(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Values (n, k) of the ellipses at the point (n, d), inside where <= 1, and their gradients (n, k, d)."""
        offset = point.unsqueeze(1) - self.center
        bent = times(self.matrix, offset)
        return (bent * offset).sum(-1), 2.0 * bent

    def slack(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Slacks (n, m + k) of rows and ellipses, and the gradients (n, m + k, d) of what they bound."""
        value, gradient = self.ellipse_values(point)
        return torch.cat((self.bounds - times(self.rows, point), 1.0 - value), -1), torch.cat((self.rows, gradient), 1)

    def depth(self, point: Tensor) -> Tensor:
        """Distance (n,) to the nearest constraint, in the units of `Constraint.violation`; negative outside."""
        slack = self.bounds - times(self.rows, point)
        depths = [torch.where(self.solid | (slack < 0.0), slack, torch.inf)]
        if self.curved:
            value = self.ellipse_values(point)[0].clamp(min=0.0)
            depths.append(self.root * (1.0 - value.sqrt()))
        return torch.cat(depths, -1).amin(-1)

    def inverse_size(self) -> Tensor:
        """Inverse size (n, 1) of the smallest ellipse, at least that of the box."""
        return self.matrix.diagonal(dim1=-2, dim2=-1).sum(-1).amax(-1, keepdim=True).sqrt().clamp(min=1.0)

    def as_cones(self, inside: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """The ellipses as cones of offset (n, k, 1 + d) - matrix (n, k, 1 + d, d) @ y for y = size (a - inside).

        Returns matrix and offset. `inside` is (n, d), `size` (n, 1).
        """
        value, axes = torch.linalg.eigh(self.matrix)
        root = value.clamp(min=0.0).sqrt().unsqueeze(-1) * axes.mT
        offset = times(root, inside.unsqueeze(1) - self.center)
        matrix = torch.nn.functional.pad(-root / size[..., None, None], (0, 0, 1, 0))
        return matrix, torch.nn.functional.pad(offset, (1, 0), value=1.0)


def scale_sets(written: ExplicitSet, lead: tuple[int, ...], check: bool = True) -> ScaledSets:
    """The sets of a batch of shape `lead`.

    With `check`, an EmptySetError names a row that no point of the box satisfies.
    """
    rows, bounds = unit_rows(written.rows, written.bounds)
    m, d = rows.shape[-2:]
    count = math.prod(lead)
    rows = rows.expand(*lead, m, d).reshape(count, m, d).cpu()
    bounds = bounds.expand(*lead, m).reshape(count, m).cpu()
    # A row that touches the box in a face, an edge or a corner is satisfied there.
    reach = rows.abs().sum(-1)
    met = torch.where(reach > 0.0, bounds >= -reach - EMPTY, bounds >= 0.0)
    if check:
        require(met, "the set is empty", name_samples(tuple(lead)), EmptySetError)
    # The row 0 <= 0 holds everywhere: give it slack.
    bounds = torch.where((rows == 0.0).all(-1) & (bounds == 0.0), 1.0, bounds)
    faces = torch.eye(d, dtype=rows.dtype, device=rows.device).expand(len(rows), d, d)
    rows = torch.cat((rows, faces, -faces), 1)
    bounds = torch.cat((bounds, rows.new_ones(len(rows), 2 * d)), 1)
    scaled = []
    for matrix, center, limit in written.ellipses:
        bound = torch.as_tensor(limit, dtype=rows.dtype, device=matrix.device)
        trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
        root = torch.where(trace > 0.0, bound * d / trace, torch.inf).sqrt()
        matrix = matrix / bound[..., None, None]
        scaled.append(
            (
                matrix.expand(*lead, d, d).reshape(-1, d, d).cpu(),
                center.expand(*lead, d).reshape(-1, d).cpu(),
                root.expand(lead).reshape(-1).cpu(),
            )
        )
    if scaled:
        matrices, centers, roots = (torch.stack(part, 1) for part in zip(*scaled, strict=True))
    else:
        matrices, centers, roots = (rows.new_zeros(len(rows), 0, *shape) for shape in ((d, d), (d,), ()))
    return ScaledSets(rows, bounds, matrices, centers, roots, name_samples(tuple(lead)))


def unit_rows(rows: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (..., m, d) scaled to unit norm with their bounds (..., m); a zero row stays as it is."""
    # In two steps, so that squares stay in range.
    largest = one_where_zero(rows.abs().amax(-1))
    for norm in (largest, one_where_zero((rows / largest.unsqueeze(-1)).norm(dim=-1))):
        rows, bounds = rows / norm.unsqueeze(-1), bounds / norm
    return rows, bounds.clamp(-1e150, 1e150)


def guessed_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) that are often interior: the centre of a single ellipse without rows, the origin otherwise."""
    alone = sets.matrix.shape[1] == 1 and sets.given_rows == 0
    return sets.center[:, 0] if alone else torch.zeros_like(sets.center[:, 0])

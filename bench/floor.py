"""The arithmetic floor of a gradient step: its matrix products and nothing else.

`update_products` lists the products that one update needs, from the widths of the layers. `Floor` computes them in
preallocated memory. Only the necessary products are listed: the critics' step needs no gradient of the critics' input;
the actor's step needs no gradient of the critics' weights, of the state, or of the actor's input. Everything else is
left out: biases, activations, losses, noise, sampling, optimiser, targets.

Names of matrices: `x0` is the input of a network, `x1` the output of its first layer, and `g1` the gradient of `x1`;
`w0` and `dw0` are the weights of its first layer and their gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from core.config import Config


@dataclass(frozen=True)
class Product:
    """`out` (rows, m, n) = `left` (rows, m, k) times `right` (rows, k, n).

    A name that ends in `.T` stands for the transpose of the matrix with the rest of the name.
    """

    left: str
    right: str
    out: str
    rows: int
    m: int
    k: int
    n: int

    @property
    def flops(self) -> int:
        """Multiplications and additions."""
        return 2 * self.rows * self.m * self.k * self.n


@dataclass(frozen=True)
class Pass:
    """A batch that passes through `rows` networks side by side."""

    network: str
    """The network that owns the weights."""
    inputs: str
    """The name of the input, a part of the matrices' names."""
    rows: int
    batch: int
    widths: Sequence[int]

    def forward(self) -> list[Product]:
        return [
            Product(self._x(i), self._w(i), self._x(i + 1), self.rows, self.batch, *self.widths[i : i + 2])
            for i in self._layers()
        ]

    def weight_gradients(self) -> list[Product]:
        return [
            Product(
                f"{self._x(i)}.T",
                self._g(i + 1),
                f"{self.network} dw{i}",
                self.rows,
                self.widths[i],
                self.batch,
                self.widths[i + 1],
            )
            for i in reversed(self._layers())
        ]

    def input_gradients(self, columns: int) -> list[Product]:
        """Gradients of every layer's input; of the network's input only the last `columns` (0: none)."""
        wanted = [columns, *self.widths[1:]]
        return [
            Product(self._g(i + 1), f"{self._w(i)}.T", self._g(i), self.rows, self.batch, self.widths[i + 1], wanted[i])
            for i in reversed(self._layers())
            if wanted[i]
        ]

    def _layers(self) -> range:
        return range(len(self.widths) - 1)

    def _x(self, layer: int) -> str:
        return f"{self.network}({self.inputs}) x{layer}"

    def _g(self, layer: int) -> str:
        return f"{self.network}({self.inputs}) g{layer}"

    def _w(self, layer: int) -> str:
        return f"{self.network} w{layer}"


@dataclass(frozen=True)
class Update:
    """The products of every update of all seeds, and the additional products of every `delay`-th update."""

    always: list[Product]
    delayed: list[Product]
    delay: int

    @property
    def flops(self) -> float:
        """Multiplications and additions of one update, on average."""
        return sum(p.flops for p in self.always) + sum(p.flops for p in self.delayed) / self.delay


def update_products(base: str, config: Config, obs_dim: int, action_dim: int, seeds: int) -> Update:
    """The products of an update of TD3 or SAC (`base`) with `seeds` seeds in lockstep."""
    batch, both = config.batch_size, 2 * seeds  # two critics for every seed
    outputs = 2 * action_dim if base == "SAC" else action_dim  # SAC's actor has a mean and a deviation
    actor = [obs_dim, *config.hidden, outputs]
    critic = [obs_dim + action_dim, *config.hidden, 1]

    next_actor = Pass("actor" if base == "SAC" else "actor target", "s'", seeds, batch, actor)
    next_critics = Pass("critic target", "s', a'", both, batch, critic)
    critics = Pass("critic", "s, a", both, batch, critic)
    critic_step = [
        *next_actor.forward(),
        *next_critics.forward(),
        *critics.forward(),
        *critics.weight_gradients(),
        *critics.input_gradients(columns=0),
    ]

    present = Pass("actor", "s", seeds, batch, actor)
    # The loss of TD3's actor uses the first critic only, that of SAC's actor the minimum of both.
    judge = Pass("critic", "s, mu(s)", both if base == "SAC" else seeds, batch, critic)
    actor_step = [
        *present.forward(),
        *judge.forward(),
        *judge.input_gradients(columns=action_dim),
        *present.weight_gradients(),
        *present.input_gradients(columns=0),
    ]
    if base == "SAC":
        return Update(critic_step + actor_step, [], 1)
    return Update(critic_step, actor_step, config.policy_delay)


class Floor:
    """Computes the products of updates one after the other, in float32.

    Matrices with the same name share memory, so that as much memory passes through the caches as in training.
    """

    def __init__(self, update: Update, device: torch.device | str = "cpu"):
        self.updates, self.delay = 0, update.delay
        shapes: dict[str, tuple[int, ...]] = {}
        for product in update.always + update.delayed:
            for name, shape in _operands(product):
                stored = shape if not name.endswith(".T") else (shape[0], shape[2], shape[1])
                key = name.removesuffix(".T")
                shapes[key] = tuple(map(max, shapes.get(key, stored), stored))
        generator = torch.Generator().manual_seed(0)
        # Small numbers, as weights are, so that no product overflows.
        self.memory = {name: 0.1 * torch.randn(shape, generator=generator) for name, shape in shapes.items()}
        self.memory = {name: matrix.to(device) for name, matrix in self.memory.items()}
        self.always = [self._views(product) for product in update.always]
        self.delayed = [self._views(product) for product in update.delayed]

    def update(self) -> None:
        """Compute the products of one update."""
        self.updates += 1
        for left, right, out in self.always:
            torch.bmm(left, right, out=out)
        if self.updates % self.delay == 0:
            for left, right, out in self.delayed:
                torch.bmm(left, right, out=out)

    def _views(self, product: Product) -> list[Tensor]:
        return [self._view(name, shape) for name, shape in _operands(product)]

    def _view(self, name: str, shape: tuple[int, ...]) -> Tensor:
        """A view of the matrix `name`: the first `shape[0]` networks.

        Of a transpose, it has only the last `shape[2]` columns (the action).
        """
        matrix = self.memory[name.removesuffix(".T")]
        if name.endswith(".T"):
            matrix = matrix.mT
            return matrix[: shape[0], :, matrix.shape[2] - shape[2] :]
        return matrix[: shape[0]]


def _operands(product: Product) -> list[tuple[str, tuple[int, ...]]]:
    """Name and shape of left, right and out."""
    rows, m, k, n = product.rows, product.m, product.k, product.n
    return [(product.left, (rows, m, k)), (product.right, (rows, k, n)), (product.out, (rows, m, n))]

"""Every operation stays on the device of its tensors: the hot path reads no values from it and copies none to it.

So a CUDA graph can capture the operations. Without a GPU, PyTorch's meta device stands in for one: its tensors have no
values, so reading a value raises an error.
"""

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from constraints import Constraint, DiagonalEllipse
from envs import TASKS

SETS = {name: task.constraint for name, task in TASKS.items()}
SETS["ellipse"] = DiagonalEllipse(lambda obs: obs[..., :3].square(), 0.1, 3)
every_set = pytest.mark.parametrize("constraint", SETS.values(), ids=SETS)


def operations(constraint: Constraint, obs: Tensor, action: Tensor, std: Tensor) -> dict[str, Tensor]:
    center = constraint.center(obs)
    ray = constraint.ray(obs, action, center)
    values = {
        "project": constraint.project(obs, action),
        "center": center,
        "gauge": constraint.gauge(obs, action, center),
        "alpha_map": constraint.alpha_map(obs, action),
        "radial_map": ray.radial_map(),
        "alpha_log_prob": ray.alpha_log_prob(0.5 * action, std),
        "alpha_log_prob in the unit ball": ray.alpha_log_prob(0.5 * action, std, unit_ball=True),
        "radial_log_prob": ray.radial_log_prob(action.sum(-1), floor=1e-6),
        "gauge_map": ray.gauge_map(),
        "gauge_log_prob": ray.gauge_log_prob(action.sum(-1)),
        "linear_oracle": constraint.linear_oracle(obs, action),
        "penalty": constraint.penalty(obs, action),
        "violation": constraint.violation(obs, action),
    }
    for name, value in list(values.items()):
        if value.requires_grad:
            (values[f"gradient of {name}"],) = torch.autograd.grad(value.sum(), action, retain_graph=True)
    return values


def inputs(constraint: Constraint) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    obs = 3.0 * torch.randn(2, 50, 17, generator=generator)
    action = torch.randn(2, 50, constraint.dim, generator=generator)
    return obs, action, torch.full_like(action, 0.4)


class OneDevice(TorchDispatchMode):
    """Raises an error when an operation moves values from one device to another."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        tensors = [x for x in args if isinstance(x, Tensor) and x.dim() > 0]
        if isinstance(out, Tensor) and out.dim() > 0 and any(x.device != out.device for x in tensors):
            raise AssertionError(f"{func} moves values to {out.device}")
        return out


@every_set
def test_nothing_is_asked_of_the_device(constraint):
    obs, action, std = (x.to("meta") for x in inputs(constraint))
    action.requires_grad_()
    operations(constraint, obs, action, std)  # tables of constants are made once
    with OneDevice():
        values = operations(constraint, obs, action, std)
    assert all(value.device.type == "meta" for value in values.values())


def test_the_stand_in_notices_questions_and_copies():
    obs, action, _ = (x.to("meta") for x in inputs(SETS["R+N"]))
    with pytest.raises(RuntimeError):
        bool((action > 0.0).any())
    with OneDevice(), pytest.raises(AssertionError):
        torch.tensor([1.0, -1.0]).to("meta")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
@every_set
def test_cuda_agrees_with_the_cpu_and_never_waits(constraint):
    obs, action, std = (x.double() for x in inputs(constraint))
    expected = operations(constraint, obs, action.requires_grad_(), std)
    there = [x.detach().cuda() for x in (obs, action, std)]
    there[1].requires_grad_()
    operations(constraint, *there)
    torch.cuda.set_sync_debug_mode("error")
    try:
        values = operations(constraint, *there)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for name, value in values.items():
        torch.testing.assert_close(value.cpu(), expected[name], rtol=1e-7, atol=1e-9, msg=name)

"""Torch's optimizers as arrays, and the guard in front of their step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from numpy.typing import NDArray

from gridnav.problem.types import NonFiniteError


def optimizer_arrays(optimizer: torch.optim.Optimizer) -> dict[str, NDArray[Any]]:
    """What the optimizer remembers of each parameter, as ``optimizer.{number}.{name}``; copies."""
    memory = optimizer.state_dict()["state"]
    return {
        f"optimizer.{number}.{name}": tensor.numpy().copy()
        for number, tensors in memory.items()
        for name, tensor in tensors.items()
    }


def load_optimizer_arrays(optimizer: torch.optim.Optimizer, arrays: dict[str, NDArray[Any]]) -> None:
    """Give an optimizer of the same parameters back what ``optimizer_arrays`` took."""
    memory: dict[int, dict[str, torch.Tensor]] = {}
    for key, array in arrays.items():
        if key.startswith("optimizer."):
            _, number, name = key.split(".")
            memory.setdefault(int(number), {})[name] = torch.from_numpy(array.copy())
    optimizer.load_state_dict({"state": memory, "param_groups": optimizer.state_dict()["param_groups"]})


def guard_gradients(optimizer: torch.optim.Optimizer, steps: Callable[[], int]) -> None:
    """Let no step of the optimizer bring a NaN or infinity into the weights.

    Args:
        optimizer: From now on raises ``NonFiniteError`` instead.
        steps: Environment steps taken so far, for the message.
    """

    def check(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        norm = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        if not torch.isfinite(norm):
            raise NonFiniteError(
                f"training stopped at step {steps()}: the gradient of the loss is {norm.item()}; the weights were not "
                "touched by it"
            )

    optimizer.register_step_pre_hook(check)

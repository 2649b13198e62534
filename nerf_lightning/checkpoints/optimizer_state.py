"""What an optimizer keeps of each parameter, held against the parameters: compiled updates do not look at shapes."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from nerf_lightning.files.schema import Number, Unfit

SIDES = (5, 7, 11, 13, 17)
"""Of the parameter that shows what an optimizer keeps: no two alike, so that each side is known again."""
WAYS = ("fused", "foreach", "capturable")
"""How the same update is computed, which depends on the device."""
Build = Callable[[Iterable[Any]], Optimizer]


def require_fitting_optimizer(state: dict[str, Any], optimizer: Optimizer, build: Build, most_steps: int) -> None:
    """Refuse the state of an optimizer that does not fit its parameters or its settings.

    Args:
        state: as its `state_dict` was saved.
        optimizer: newly made, over the parameters that the state belongs to.
        build: makes an optimizer of this kind.
        most_steps: that it can have taken.

    Raises:
        Unfit: other parameters or settings, or tensors of other shapes, types or ranges.
    """
    _require_groups(state["param_groups"], optimizer.state_dict()["param_groups"])
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    found = state["state"]
    if not (found == {} or set(found) == set(range(len(parameters)))):
        raise Unfit("optimizer_states", f"holds the state of {len(found)} of {len(parameters)} parameters")
    shapes = {dim: _kept(build, dim) for dim in {parameter.dim() for parameter in parameters}} if found else {}
    for number, parameter in enumerate(parameters if found else []):
        _require_entry(found[number], parameter, shapes[parameter.dim()], most_steps, f"optimizer_states.{number}")


def _require_groups(groups: list[dict[str, Any]], known: list[dict[str, Any]]) -> None:
    if len(groups) != len(known):
        raise Unfit("optimizer_states", f"has {len(groups)} groups of parameters, where there are {len(known)}")
    for number, (group, ours) in enumerate(zip(groups, known, strict=True)):
        place = f"optimizer_states.param_groups[{number}]"
        # `base_lr` is the system's own: the rate before the schedule, as it was lowered by rollbacks.
        if set(group) - {"base_lr"} != set(ours):
            raise Unfit(place, f"has the settings {', '.join(map(ascii, group))}, not {', '.join(ours)}")
        for key, value in group.items():
            if key in ("lr", "base_lr"):
                # The schedule sets the first anew at every step.
                Number(0.0, ours["lr"] if key == "base_lr" else math.inf).require(value, f"{place}.{key}", {})
            elif key in WAYS:
                if value not in (None, True, False):
                    raise Unfit(f"{place}.{key}", "is not true or false")
            elif type(value) is not type(ours[key]) or value != ours[key]:
                raise Unfit(f"{place}.{key}", "is not what the run's config says")


def _kept(build: Build, dim: int) -> dict[str, Any]:
    """Return what this kind of optimizer keeps of a parameter with so many sides, by taking a step of one."""
    parameter = nn.Parameter(torch.zeros(SIDES[:dim]))
    parameter.grad = torch.zeros_like(parameter)
    optimizer = build([parameter])
    optimizer.step()
    return dict(optimizer.state[parameter])


def _require_entry(entry: object, parameter: Tensor, kept: dict[str, Any], most_steps: int, place: str) -> None:
    if not isinstance(entry, dict) or set(entry) != set(kept):
        raise Unfit(place, f"does not hold {', '.join(kept)}, as this optimizer does")
    sides = dict(zip(SIDES, parameter.shape, strict=False))
    for key, example in kept.items():
        value, here = entry[key], f"{place}.{key}"
        if not isinstance(example, Tensor):
            if type(value) is not type(example) or not 0 <= value <= most_steps:
                raise Unfit(here, f"is not a number from 0 to {most_steps}")
            continue
        shape = tuple(sides.get(side, side) for side in example.shape)
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.shape != shape:
            raise Unfit(here, f"is not a tensor of the shape {shape}")
        if value.dtype != example.dtype:
            raise Unfit(here, f"holds {value.dtype}, not {example.dtype}")
        least, greatest = (float(end) for end in value.aminmax()) if value.numel() else (0.0, 0.0)
        # Means of squares, and counts of steps, are not negative. The comparisons refuse NaN.
        low, high = (0.0 if key.endswith("_sq") else -1e30), 1e30
        if not example.dim() and not 0.0 <= least <= most_steps:
            raise Unfit(here, f"is not a number from 0 to {most_steps}")
        if not low <= least <= greatest <= high:
            raise Unfit(here, "holds NaN, infinity, or what no optimizer keeps")

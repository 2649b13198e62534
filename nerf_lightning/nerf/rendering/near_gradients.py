"""Gradients scaled down near cameras, against floaters (Philip and Deschaintre, EGSR 2023, arXiv 2305.02756).

The distance: `gradient_scaling_distance` in conf/model/fast_proposal.yaml.
Kernels repeat it: `kernels/render/compositing.py` and `cuda.py`, `kernels/field/cuda.py`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.renderings import FieldOutput


def soften_near_gradients(
    output: FieldOutput, distance: Float[Tensor, "*rays samples"], whole_from: float
) -> FieldOutput:
    """Return the same values, with gradients multiplied by min(1, (distance / whole_from)^2).

    A camera's pixels share a small volume near it, so points there receive as many gradients from one photograph as
    those farther away do from all: matter grows in front of a camera, and no other photograph contradicts it.

    Args:
        output: density and color of samples.
        distance: distance from the camera, scene units.
        whole_from: distance from which on gradients are whole, > 0.
    """
    share = (distance.detach() / whole_from).square().clamp(max=1.0)
    channels = {name: _Scaled.apply(each, share[..., None]) for name, each in output.channels.items()}
    density, rgb = _Scaled.apply(output.density, share), _Scaled.apply(output.rgb, share[..., None])
    return FieldOutput(density, rgb, channels=channels)


class _Scaled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, share: Tensor) -> Tensor:
        ctx.save_for_backward(share)
        return values.view_as(values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (share,) = ctx.saved_tensors
        return grad * share, None

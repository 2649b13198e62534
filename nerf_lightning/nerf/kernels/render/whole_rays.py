"""Whether rays can be rendered from end to end in one kernel: for which machine and field there is one."""

from types import ModuleType

import torch

from nerf_lightning.nerf.kernels.backends import cpu_twin, is_on
from nerf_lightning.nerf.kernels.render.parts import FieldParts
from nerf_lightning.nerf.products import Products


def whole_rays(
    field: FieldParts | None, products: Products, device: torch.device, gradients: bool = False
) -> tuple[ModuleType, torch.dtype] | None:
    """Return the kernel's module and what it multiplies; None where it does not take the field, or the precision.

    Args:
        field: None: of a kind that no kernel knows.
        products: the precision of its products.
        device: of its parameters, and the rays.
        gradients: whether they are wanted, for the field's parameters alone.
    """
    module = "render.gradients" if gradients else "render.cpu"
    perceptrons = cpu_twin("mlp.cpu", device) if field is not None and is_on(module) else None
    if field is None or perceptrons is None:
        return None
    dtype = torch.bfloat16 if products == "bfloat16" else torch.float32
    if field.table.dtype != torch.float32 or not all(perceptrons.takes(each, dtype) for each in field.weights):
        return None
    kernels = cpu_twin(module, device)
    return None if kernels is None else (kernels, dtype)

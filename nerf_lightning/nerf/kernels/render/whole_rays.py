"""Whether rays can be rendered from end to end in one kernel: for which machine, field and precision there is one."""

from types import ModuleType

import torch

from nerf_lightning.nerf.kernels.backends import is_on, twin
from nerf_lightning.nerf.kernels.render.parts import FieldParts
from nerf_lightning.nerf.products import Products, cpu_multiplies_bfloat16


def whole_rays(field: FieldParts | None, products: Products, device: torch.device) -> ModuleType | None:
    """Return the kernel's module: for CPUs that multiply bfloat16, and widths that are whole vectors; else None."""
    if field is None or device.type != "cpu" or products != "bfloat16" or not cpu_multiplies_bfloat16():
        return None
    perceptrons = twin("mlp.bfloat16") if is_on("render.bfloat16") and is_on("mlp.bfloat16") else None
    if perceptrons is None or not all(perceptrons.takes([w.shape[1] for w in weights]) for weights in field.weights):
        return None
    return twin("render.bfloat16")

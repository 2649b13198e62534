"""`nerf bench`: the compiled kernels against the same mathematics in torch, eager and compiled."""

from collections.abc import Callable

import torch
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import can_compile
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.kernels.mlp.op import mlp, mlp_torch
from nerf_lightning.nerf.matmul_precision import MatmulPrecision, cpu_multiplies_bfloat16

POINTS, RAY_SAMPLES = 65_536, 32


def compared_kernels(device: torch.device) -> dict[str, dict[str, Callable[[], None]]]:
    """Return our kernels and torch's equivalents, forward and backward; "ours" comes first."""
    compared = {"hash grid 8 x 4": _hash_grid(device), "MLP 32-64-64-3": _mlp(device, "float32")}
    if device.type != "cpu" or cpu_multiplies_bfloat16():
        compared["MLP 32-64-64-3 in bfloat16"] = _mlp(device, "bfloat16")
    return compared


def points_along_rays(device: torch.device) -> Tensor:
    """Return points of the unit cube in the order of rays: neighbors are close together."""
    start = torch.rand(POINTS // RAY_SAMPLES, 1, 3)
    along = 0.003 * torch.nn.functional.normalize(torch.randn_like(start), dim=-1)
    points = start + along * torch.arange(RAY_SAMPLES)[:, None]
    return points.reshape(-1, 3).clamp(0, 1).to(device)


def _hash_grid(device: torch.device) -> dict[str, Callable[[], None]]:
    layout = hash_grid_layout(8, 18, 16, 512)
    table = torch.randn(layout.offsets[-1], 4, device=device, requires_grad=True)
    points, grad = points_along_rays(device), torch.randn(POINTS, 32, device=device)
    return _kinds(lambda fn: fn(table, points, layout), interpolate, interpolate_torch, [table], grad)


def _mlp(device: torch.device, matmul_precision: MatmulPrecision) -> dict[str, Callable[[], None]]:
    weights = [torch.randn(b, a, device=device, requires_grad=True) for a, b in ((32, 64), (64, 64), (64, 3))]
    points = torch.randn(POINTS, 32, device=device, requires_grad=True)
    leaves, grad = [points, *weights], torch.randn(POINTS, 3, device=device)
    return _kinds(lambda fn: fn(points, weights, matmul_precision), mlp, mlp_torch, leaves, grad)


def _kinds(
    call: Callable[[Callable], Tensor], ours: Callable, reference: Callable, leaves: list[Tensor], grad: Tensor
) -> dict[str, Callable[[], None]]:
    def both_ways(fn: Callable) -> Callable[[], None]:
        def run() -> None:
            for leaf in leaves:
                leaf.grad = None
            call(fn).backward(grad)

        return run

    kinds = {"ours": both_ways(ours), "eager": both_ways(reference)}
    if can_compile(grad.device):
        kinds["compiled"] = both_ways(torch.compile(reference))
    return kinds

"""Each kernel that the device uses, against its reference: plain torch on the CPU in float64."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.config.exporters import kernel_modules
from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.adam.step import adam_step, adam_step_torch
from nerf_lightning.nerf.kernels.hash_grid.interpolate import interpolate
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.march.march import march
from nerf_lightning.nerf.kernels.march.reference import march_torch
from nerf_lightning.nerf.kernels.mlp.mlp import mlp, mlp_torch
from nerf_lightning.nerf.kernels.packed.integrate import integrate, num_visible
from nerf_lightning.nerf.kernels.packed.reference import integrate_torch, transmittance_torch
from nerf_lightning.nerf.kernels.search import search
from nerf_lightning.nerf.products import TILE_ROWS as TILE
from nerf_lightning.nerf.products import Products
from nerf_lightning.nerf.samplers.space_carving import possible_cells
from nerf_lightning.nerf.types.rays import PackedSamples, RayBundle
from nerf_lightning.selftest.check import (
    UNIT,
    CannotRun,
    Check,
    gradient_bound,
    largest,
    norm_apart,
    relative,
    value_bound,
)
from nerf_lightning.selftest.place import Place
from nerf_lightning.selftest.scene import ball_scene

POINTS, RAYS = 2048, 400
GRID_TERMS, PACKED_SAMPLES, MLP_SIZES = 64, 60, (32, 64, 64, 3)
ROUNDING = UNIT["float32"]


def checks(place: Place) -> list[Check]:
    """Return the checks of all kernels that this device uses, and of the precisions of its products."""
    device = place.device
    return [
        *_twins(place),
        Check(
            "hash grid: features",
            16 * ROUNDING,
            "8 corners, each a product of 4 numbers: at most 16 roundings of float32",
            lambda: _hash_grid(device, wanted=0),
        ),
        Check(
            "hash grid: gradient of the table",
            GRID_TERMS * ROUNDING,
            f"an entry adds up less than {GRID_TERMS} terms, in any order",
            lambda: _hash_grid(device, wanted=1),
        ),
        Check(
            "hash grid: gradient of the points",
            8 * 8 * 4 * ROUNDING,
            "8 levels of 8 corners of 4 features are added up",
            lambda: _hash_grid(device, wanted=2),
        ),
        Check(
            "march: rays with other intervals",
            0.01,
            "the share of rays of which a midpoint lies on a cell's face to the last bits: about 1 in 1000",
            lambda: _march(device, capacity=None),
        ),
        Check(
            "march into a fixed capacity: rays with other intervals",
            0.01,
            "as above; what exceeds the capacity is dropped from the last rays and counted",
            lambda: _march(device, capacity=1 << 15),
        ),
        Check(
            "packed samples: light, opacity, depth, weights",
            8 * PACKED_SAMPLES * ROUNDING,
            f"sums of at most {PACKED_SAMPLES} terms, whose transmittances are exponentials of such sums",
            lambda: _packed(device, gradients=False),
        ),
        Check(
            "packed samples: gradients",
            8 * PACKED_SAMPLES * ROUNDING,
            f"as above, back along the ray; sums of at most {PACKED_SAMPLES} terms",
            lambda: _packed(device, gradients=True),
        ),
        Check(
            "packed samples: where rays become opaque",
            0.01,
            "the share of rays whose light comes within rounding of the threshold at a sample",
            lambda: _num_visible(device),
        ),
        Check(
            "adam: weights and moments",
            16 * ROUNDING,
            "about 12 roundings an entry",
            lambda: _adam(device),
        ),
        Check("carving: cells with another answer", 0.0, "the same operations in the same order", _carving),
        Check("search in sorted numbers", 0.0, "whole numbers", lambda: _search(device)),
        *[check for products in place.products for check in _perceptrons(place, products)],
        *([] if "tf32" in place.products else [_absent("perceptron, tf32", "only NVIDIA GPUs multiply in tf32")]),
    ]


def _twins(place: Place) -> list[Check]:
    """Return a check for each compiled kernel: whether it runs at all. What it computes, the checks below say."""
    if place.is_cuda:
        return [_loads(f"{backends.KERNELS}.{each}.cuda", "triton") for each in ("hash_grid", "mlp")]
    if place.device.type == "cpu":
        found = [_loads(name, "numba") for name in kernel_modules()]
        return [*found, _absent("hash_grid (triton)", "it is for GPUs, and the device here is the CPU")]
    return []


def _loads(module: str, library: str) -> Check:
    def difference() -> float:
        if backends.twin(module) is None:
            raise CannotRun(f"{backends.why_not(module)}: plain torch does its work, many times slower")
        return 0.0

    name = module.removeprefix(f"{backends.KERNELS}.").removesuffix(".cpu").removesuffix(".cuda")
    return Check(f"{name} ({library}): compiles and runs", 0.0, "it was compiled and gave finite numbers", difference)


def _absent(name: str, reason: str) -> Check:
    def difference() -> float:
        raise CannotRun(reason)

    return Check(name, 0.0, reason, difference)


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(20260101)


def _both_ways(fn: Callable[..., Tensor], leaves: list[Tensor], grad: Tensor) -> list[Tensor]:
    """Return a function's value and its gradients by its arguments."""
    leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
    out = fn(*leaves)
    out.backward(grad.to(out))
    return [out.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]


def _hash_grid(device: torch.device, wanted: int) -> float:
    """Return the difference of the features (0), the table's gradient (1) or the points' (2)."""
    layout, random = hash_grid_layout(8, 14, 16, 512), _generator()
    # Whole multiples of 1/4096: their cells and weights are exact in float32, so no point changes its cell.
    points = torch.randint(-100, 4196, (POINTS, 3), generator=random) / 4096.0
    table = torch.randn(layout.offsets[-1], 4, generator=random)
    grad = torch.randn(POINTS, 32, generator=random)
    found = _both_ways(lambda t, p: interpolate(t, p, layout), [table.to(device), points.to(device)], grad.to(device))
    expected = _both_ways(lambda t, p: interpolate_torch(t, p, layout), [table.double(), points.double()], grad)
    # On the cube's faces the derivative by the points has two values.
    kept = ((points > 0) & (points < 1)).all(dim=-1) if wanted == 2 else slice(None)
    return relative(found[wanted].cpu()[kept], expected[wanted][kept])


def _march(device: torch.device, capacity: int | None) -> float:
    random, box = _generator(), torch.tensor([[-1.0, -1.2, -0.9], [1.0, 1.2, 0.9]])
    eyes = 4.0 * torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=random), dim=-1)
    along = torch.nn.functional.normalize(0.3 * torch.randn(RAYS, 3, generator=random) - eyes, dim=-1)
    two, whole = torch.full((RAYS,), 2.0), torch.zeros(RAYS, dtype=torch.long)
    rays = RayBundle(eyes, along, two, 3 * two, along)
    enter, leave = distances_in_box(rays, 2.0 * box)
    state = MarchState(enter, leave, torch.rand(RAYS, generator=random), whole)
    cells = (torch.rand(2, 16, 16, 16, generator=random) < 0.3).to(torch.uint8)
    grid = OccupancyCells(box, cells, leaps_over(blocks_of(cells)))
    lattice = torch.arange(1.9, 6.2, 0.02)
    expected, _ = march_torch(rays, state, lattice, grid, None, None)
    found, _ = march(rays.to(device), state.to(device), lattice.to(device), grid.to(device), capacity=capacity)
    if capacity is not None and found.starts.numel() != capacity:
        raise ValueError(f"the arrays have {found.starts.numel()} entries, and their capacity is {capacity}")
    return _rays_apart(found.to("cpu"), expected)


def _rays_apart(found: PackedSamples, expected: PackedSamples) -> float:
    """Return the share of rays whose intervals differ in number, or by more than rounding in their place."""
    apart = found.bounds.diff() != expected.bounds.diff()
    for ray in (~apart).nonzero()[:, 0].tolist():
        ours, theirs = (slice(*each.bounds[ray : ray + 2].tolist()) for each in (found, expected))
        for name in ("starts", "ends"):
            gap = (getattr(found, name)[ours] - getattr(expected, name)[theirs]).abs()
            apart[ray] |= bool((gap > 1e-5).any())
        apart[ray] |= bool((found.ray_index[ours] != ray).any())
    return float(apart.double().mean())


def _packed_samples() -> tuple[Tensor, Tensor, PackedSamples]:
    random = _generator()
    counts = torch.arange(RAYS) % (PACKED_SAMPLES + 1)
    index = torch.repeat_interleave(torch.arange(RAYS), counts)
    bounds = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    starts = 2.0 + 0.0625 * (torch.arange(index.numel()) - bounds[index])
    density = 3.0 * torch.rand(index.numel(), generator=random)
    rgb = torch.rand(index.numel(), 3, generator=random)
    return density, rgb, PackedSamples(index, starts, starts + 0.0625, bounds, bounds[-1])


def _packed(device: torch.device, gradients: bool) -> float:
    density, rgb, samples = _packed_samples()
    exact = PackedSamples(
        samples.ray_index, samples.starts.double(), samples.ends.double(), samples.bounds, samples.found
    )
    results = []
    for fn, given, place in (
        (integrate, [density.to(device), rgb.to(device)], samples.to(device)),
        (integrate_torch, [density.double(), rgb.double()], exact),
    ):
        leaves = [each.clone().requires_grad_() for each in given]
        parts = fn(leaves[0], leaves[1], place)
        random = _generator()
        loss = sum((part * torch.randn(part.shape, generator=random).to(part)).sum() for part in parts)
        loss.backward()  # type: ignore[union-attr]
        results.append([leaf.grad for leaf in leaves] if gradients else list(parts))
    return largest([relative(found, expected) for found, expected in zip(*results, strict=True)])


def _num_visible(device: torch.device) -> float:
    density, _, samples = _packed_samples()
    found = num_visible(density.to(device), samples.to(device), 0.1).cpu()
    exact = PackedSamples(
        samples.ray_index, samples.starts.double(), samples.ends.double(), samples.bounds, samples.found
    )
    seen = (transmittance_torch(density.double(), exact) > 0.1).long()
    expected = torch.zeros(RAYS, dtype=torch.long).index_add(0, samples.ray_index, seen)
    return float((found != expected).double().mean())


def _adam(device: torch.device) -> float:
    random = _generator()
    weights, grad, first = (torch.randn(POINTS, generator=random) for _ in range(3))
    grad = grad * (torch.rand(POINTS, generator=random) < 0.5)
    given = [weights, grad, first, torch.rand(POINTS, generator=random)]
    ours, exact = [each.to(device) for each in given], [each.double() for each in given]
    settings: Any = (0.03, 1.5, (0.9, 0.99), 1e-15)
    adam_step(ours[0], ours[1], ours[2], ours[3], *settings)
    adam_step_torch(exact[0], exact[1], exact[2], exact[3], *settings)
    return largest([relative(found, expected) for found, expected in zip(ours, exact, strict=True)])


def _carving() -> float:
    centers = 1.5 * torch.randn(20_000, 3, generator=_generator())
    scene = ball_scene()
    with backends.without("carving.cpu"):
        expected = possible_cells(scene, centers, 0.05)
    return float((possible_cells(scene, centers, 0.05) != expected).sum())


def _search(device: torch.device) -> float:
    random = _generator()
    ordered = torch.rand(50, 20, generator=random).sort(-1).values
    numbers = torch.cat([torch.rand(50, 30, generator=random), ordered[:, ::3]], dim=-1)
    differences = []
    for right in (False, True):
        expected = torch.searchsorted(ordered, numbers, right=right)
        differences.append(relative(search(ordered.to(device), numbers.to(device), right), expected))
    return largest(differences)


def _perceptrons(place: Place, products: Products) -> list[Check]:
    layers = len(MLP_SIZES) - 1
    return [
        Check(
            f"perceptron, {products}: value",
            value_bound(products, layers),
            f"{layers} layers, each with a few roundings to {products}; 4 standard deviations",
            lambda: _mlp(place.device, products)[0],
        ),
        Check(
            f"perceptron, {products}: gradients",
            gradient_bound(products, layers),
            f"the same, and ReLUs within rounding of zero, which switch; {layers} layers",
            lambda: largest(_mlp(place.device, products)[1:]),
        ),
    ]


def _mlp(device: torch.device, products: Products) -> list[float]:
    """Return how far value and gradients are off, over their norms."""
    random = _generator()
    points = torch.randn(2 * TILE + 17, MLP_SIZES[0], generator=random)
    weights = [torch.randn(b, a, generator=random) / (a / 2) ** 0.5 for a, b in pairwise(MLP_SIZES)]
    grad = torch.randn(2 * TILE + 17, MLP_SIZES[-1], generator=random)
    given = [points, *weights]
    ours = [each.to(device) for each in given]
    found = _both_ways(lambda p, *w: mlp(p, list(w), products), ours, grad.to(device))
    expected = _both_ways(lambda p, *w: mlp_torch(p, list(w)), [each.double() for each in given], grad)
    return [norm_apart(one, other) for one, other in zip(found, expected, strict=True)]

"""Each kernel that the device uses, against its reference: plain torch on the CPU in float64."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from nerf_lightning.extensions.selftest.check import (
    UNIT,
    CannotRun,
    Check,
    gradient_bound,
    norm_apart,
    relative,
    value_bound,
)
from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, CUDA_BACKENDS
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.march.op import march
from nerf_lightning.nerf.kernels.march.reference import march_torch
from nerf_lightning.nerf.kernels.mlp.op import mlp, mlp_torch
from nerf_lightning.nerf.kernels.ragged.op import integrate
from nerf_lightning.nerf.kernels.ragged.reference import integrate_torch
from nerf_lightning.nerf.matmul_precision import TILE_ROWS, MatmulPrecision
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle

POINTS, RAYS, PACKED_SAMPLES, MLP_SIZES = 2048, 400, 60, (32, 64, 64, 3)
ROUNDING, LAYERS = UNIT["float32"], len(MLP_SIZES) - 1
HASH_GRID_SUMS = {"features": 16, "gradient of the table": 64, "gradient of the points": 256}
"""Results, and the number of roundings that add up in each."""
BOUNDS = {"value": value_bound, "gradients": gradient_bound}


def checks(device: torch.device, precisions: Sequence[MatmulPrecision]) -> list[Check]:
    """Return the checks of the kernels that this device uses: each compiles, and the large ones agree with torch.

    The others (Adam, carving, search, where rays become opaque) are part of the trainings that `training` compares.
    """
    names, library = (CUDA_BACKENDS, "triton") if device.type == "cuda" else (CPU_BACKENDS, "numba")
    face = "the share of rays of which a midpoint lies on a cell's face to the last bits: about 1 in 1000"
    sums = f"sums of at most {PACKED_SAMPLES} terms, whose transmittances are exponentials of such sums"
    found = [
        Check(f"{backend} ({library}): compiles and runs", 0.0, "or torch works", partial(_loads, backend))
        for backend in names
    ]
    for index, (what, terms) in enumerate(HASH_GRID_SUMS.items()):
        compare = partial(_hash_grid, device, index)
        found.append(Check(f"hash grid: {what}", terms * ROUNDING, f"{terms} roundings of float32", compare))
    found.append(Check("march: rays with other intervals", 0.01, face, partial(_march, device)))
    for what in BOUNDS:
        compare = partial(_packed, device, what)
        found.append(Check(f"ragged samples: {what}", 8 * PACKED_SAMPLES * ROUNDING, sums, compare))
    for matmul_precision in precisions:
        for what, bound in BOUNDS.items():
            name, because = f"perceptron, {matmul_precision}: {what}", f"{LAYERS} layers of {matmul_precision} products"
            compare = partial(_mlp, device, matmul_precision, what)
            found.append(Check(name, bound(matmul_precision, LAYERS), because, compare))
    return found


def _loads(backend: str) -> float:
    module = f"{backends.KERNELS}.{backend}"
    if backends.backend(module) is None:
        raise CannotRun(f"{backends.why_not(module)}: plain torch does its work, many times slower")
    return 0.0


def _largest(differences: list[float]) -> float:
    return float(torch.tensor(differences).max())  # NaN if one is


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(20260101)


def _results(function: Callable[..., Sequence[Tensor]], inputs: Sequence[Tensor]) -> dict[str, list[Tensor]]:
    """Return the value of a function, and its gradients with respect to its arguments under random weights."""
    leaves, random = [each.detach().clone().requires_grad_() for each in inputs], _generator()
    out = function(*leaves)
    torch.autograd.backward(out, [torch.randn(each.shape, generator=random).to(each) for each in out])
    return {"value": list(out), "gradients": [leaf.grad for leaf in leaves if leaf.grad is not None]}


def _hash_grid(device: torch.device, index: int) -> float:
    """Compare the features (0), the table's gradient (1) or the points' (2)."""
    layout, random = hash_grid_layout(8, 14, 16, 512), _generator()
    # Multiples of 1/4096: their cells and weights are exact in float32, so no point changes its cell.
    points = torch.randint(-100, 4196, (POINTS, 3), generator=random) / 4096.0
    given = [torch.randn(layout.offsets[-1], 4, generator=random), points]
    found = _results(lambda t, p: [interpolate(t, p, layout)], [each.to(device) for each in given])
    exact = _results(lambda t, p: [interpolate_torch(t, p, layout)], [each.double() for each in given])
    ours, expected = ([*each["value"], *each["gradients"]][index].cpu() for each in (found, exact))
    # On the cube's faces, the derivative with respect to the points has two values.
    kept = ((points > 0) & (points < 1)).all(dim=-1) if index == 2 else slice(None)
    return relative(ours[kept], expected[kept])


def _march(device: torch.device) -> float:
    """Return the share of rays whose intervals differ in number, or in position by more than rounding."""
    random, box = _generator(), torch.tensor([[-1.0, -1.2, -0.9], [1.0, 1.2, 0.9]])
    eyes = 4.0 * torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=random), dim=-1)
    along = torch.nn.functional.normalize(0.3 * torch.randn(RAYS, 3, generator=random) - eyes, dim=-1)
    two, whole = torch.full((RAYS,), 2.0), torch.zeros(RAYS, dtype=torch.long)
    rays = RayBundle(eyes, along, two, 3 * two, along)
    state = MarchState(*distances_in_box(rays, box), torch.rand(RAYS, generator=random), whole)
    cells = (torch.rand(16, 16, 16, generator=random) < 0.3).to(torch.uint8)
    grid = OccupancyCells(box, cells, leaps_over(blocks_of(cells)))
    lattice = torch.arange(1.9, 6.2, 0.02)
    expected, _ = march_torch(rays, state, lattice, grid, None, None)
    found, _ = march(rays.to(device), state.to(device), lattice.to(device), grid.to(device))
    return sum(_of_ray(found.to("cpu"), ray) != _of_ray(expected, ray) for ray in range(RAYS)) / RAYS


def _of_ray(samples: RaggedSamples, ray: int) -> list[list[float]]:
    """Return index, starts and ends of a ray's samples, to 4 decimals."""
    own = slice(*samples.bounds[ray : ray + 2].tolist())
    places = 1e4 * torch.stack([samples.starts[own], samples.ends[own]])
    return [samples.ray_index[own].float().tolist(), *places.round().tolist()]


def _packed_samples() -> tuple[Tensor, Tensor, RaggedSamples, RaggedSamples]:
    """Return densities, colors, samples, and the same in float64."""
    random, counts = _generator(), torch.arange(RAYS) % (PACKED_SAMPLES + 1)
    index = torch.repeat_interleave(torch.arange(RAYS), counts)
    bounds = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    starts = 2.0 + 0.0625 * (torch.arange(index.numel()) - bounds[index])
    density = 3.0 * torch.rand(index.numel(), generator=random)
    rgb = torch.rand(index.numel(), 3, generator=random)
    single, double = (RaggedSamples(index, s, s + 0.0625, bounds, bounds[-1]) for s in (starts, starts.double()))
    return density, rgb, single, double


def _packed(device: torch.device, what: str) -> float:
    density, rgb, samples, exact = _packed_samples()
    here = samples.to(device)
    found = _results(lambda d, c: list(integrate(d, c, here)), [density.to(device), rgb.to(device)])
    expected = _results(lambda d, c: list(integrate_torch(d, c, exact)), [density.double(), rgb.double()])
    return _largest([relative(*pair) for pair in zip(found[what], expected[what], strict=True)])


def _mlp(device: torch.device, matmul_precision: MatmulPrecision, what: str) -> float:
    """Return how far the value or the gradients are off, over their norms."""
    random = _generator()
    points = torch.randn(2 * TILE_ROWS + 17, MLP_SIZES[0], generator=random)
    weights = [torch.randn(b, a, generator=random) / (a / 2) ** 0.5 for a, b in pairwise(MLP_SIZES)]
    given = [points, *weights]
    found = _results(lambda p, *w: [mlp(p, list(w), matmul_precision)], [each.to(device) for each in given])
    expected = _results(lambda p, *w: [mlp_torch(p, list(w))], [each.double() for each in given])
    return _largest([norm_apart(*pair) for pair in zip(found[what], expected[what], strict=True)])

"""Samples to pixels on CUDA: the operations between the large kernels, in one pass each.

The hash grid, the MLPs and the quadrature have their own kernels; the steps from rays to points, from hidden features
to the inputs of the color, and from raw outputs to density and color are functions of single samples, which plain torch
would compute in dozens of passes. `TRITON_INTERPRET=1` runs the kernels without a GPU. Results are deterministic,
except for the gradient of the hash grid, which is summed atomically.
"""

from dataclasses import replace
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.activations import LARGEST_RAW, LARGEST_SLOPE_RAW
from nerf_lightning.nerf.kernels.backends import cuda_backend
from nerf_lightning.nerf.kernels.field.cuda import Samples, color_slope, inside, midpoint
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate
from nerf_lightning.nerf.kernels.mlp.op import mlp
from nerf_lightning.nerf.kernels.ragged.op import Integrated, integrate, integrate_dense
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples

BLOCK = 256


def render(
    rays: RayBundle,
    samples: RaggedSamples | RaySamples,
    field: FieldParts,
    matmul_precision: MatmulPrecision,
    closed: bool,
    whole_from: float,
    features: Float[Tensor, "samples features"] | None,
) -> Integrated:
    """Return the integrals along rays, with gradients for the field's table and weights.

    Args:
        rays: unit directions, scene units; one axis.
        samples: the samples along them.
        field: table and weights; without weights of color, everything is black.
        matmul_precision: precision of the MLPs' products.
        closed: whether the last sample of a ray absorbs all remaining light.
        whole_from: gradients of samples nearer than this are scaled down (`rendering.near_gradients`); 0: of none.
        features: features of the hash grid, if `density` has computed them; None: they are computed here.
    """
    where = _located(rays, samples, field)
    density, rgb = _density_and_color(rays, where, field, matmul_precision, whole_from, features)[:2]
    if isinstance(samples, RaggedSamples):
        return integrate(density, rgb, samples)
    shape = rays.near.shape[0], where.each
    found = integrate_dense(density.view(shape), rgb.view(*shape, 3), samples.edges, closed)
    assert found is not None
    return found


def density(
    rays: RayBundle, samples: RaggedSamples, field: FieldParts, matmul_precision: MatmulPrecision
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples features"]]:
    """Return the density and the features of the hash grid at samples, without gradients."""
    where, plain = _located(rays, samples, field), replace(field, color_weights=[])
    with torch.no_grad():
        found, _, features = _density_and_color(rays, where, plain, matmul_precision, 0.0, None)
    return found, features


def _density_and_color(
    rays: RayBundle,
    where: Samples,
    field: FieldParts,
    matmul_precision: MatmulPrecision,
    whole_from: float,
    features: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return density, color and the features of the hash grid."""
    fused = _fused(field, rays, matmul_precision)
    dtype = torch.float32 if fused is None else torch.bfloat16
    features = interpolate(field.table, where.points, field.layout, features, where.used, dtype)
    shared = field.ray_features(rays) if field.color_weights else where.points.new_empty(1, 0)
    if fused is not None:
        how = fused.Activations(field.bias, field.least_slope, whole_from, not field.contracted)
        weights = len(field.density_weights), *field.density_weights, *field.color_weights
        return *_Fused.apply(features, fused, shared, where, how, *weights), features
    hidden = mlp(features, field.density_weights, matmul_precision, where.used)
    raw = hidden.new_empty(0, 3)
    if field.color_weights:
        raw = mlp(_Joined.apply(hidden, shared, where), field.color_weights, matmul_precision, where.used)
    return *_Activated.apply(hidden, raw, where, field, whole_from), features


def _fused(field: FieldParts, rays: RayBundle, matmul_precision: MatmulPrecision) -> Any:
    """Return the kernels that take both MLPs in one pass; None if they do not take these."""
    kernels: Any = cuda_backend("field.cuda", rays.near.device) if matmul_precision == "bfloat16" else None
    widths = ((each[0].shape[1], *(layer.shape[0] for layer in each)) if each else () for each in field.weights)
    return kernels if kernels is not None and kernels.takes(*widths, rays.near.device) else None


class _Fused(torch.autograd.Function):
    """Density and color from the features of the hash grid."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        kernels: Any,
        shared: Tensor,
        where: Samples,
        how: Any,
        layers: int,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor]:
        mlps = [each.detach() for each in weights[:layers]], [each.detach() for each in weights[layers:]]
        ctx.kernels, ctx.arguments = kernels, (shared.detach(), where, *mlps, how)
        keep = any(ctx.needs_input_grad)
        density, rgb, saved = kernels.forward(features.detach(), *ctx.arguments, keep)
        ctx.save_for_backward(features, *saved)
        return density, rgb

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_density: Tensor, of_rgb: Tensor) -> tuple[Tensor | None, ...]:
        features, *saved = ctx.saved_tensors
        of_features, of_weights = ctx.kernels.backward(of_density, of_rgb, tuple(saved), features, *ctx.arguments)
        return of_features, None, None, None, None, None, *of_weights


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    one, along = torch.ones(2, device=device), torch.tensor([[0.0, 0.0, 1.0]] * 2, device=device)
    rays, layout = RayBundle(-2 * along, along, one, 3 * one, along), hash_grid_layout(2, 6, 2, 8)
    table = torch.ones(layout.offsets[-1], 2, device=device, requires_grad=True)
    weights = [torch.ones(16, 4, device=device, requires_grad=True), torch.ones(3, 19, device=device)]
    aabb = torch.tensor([[-1.0] * 3, [1.0] * 3], device=device)
    field = FieldParts(aabb, table, layout, 0.0, weights[:1], weights[1:], lambda rays: rays.view_directions)
    samples = RaySamples(torch.tensor([[1.0, 2.0, 3.0]] * 2, device=device))
    with torch.enable_grad():
        foreground, opacity, _, _ = render(rays, samples, field, "float32", False, 1.0, None)
        (foreground.sum() + opacity.sum()).backward()
    if table.grad is None or not bool(table.grad.isfinite().all()) or float(opacity[0].detach()) < 0.9:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


def _located(rays: RayBundle, samples: RaggedSamples | RaySamples, field: FieldParts) -> Samples:
    """Return samples with their midpoints in the unit cube (`NGPField._unit`); without gradients."""
    if isinstance(samples, RaggedSamples):
        arrays, each, used = (samples.ray_index, samples.starts, samples.ends), 0, samples.bounds[-1:]
        count = samples.starts.shape[0]
    else:
        edges, each, used = samples.edges.contiguous(), samples.edges.shape[-1] - 1, None
        arrays, count = (edges, edges, edges.view(-1)[1:]), rays.near.shape[0] * each
    points = torch.empty(count, 3, device=rays.near.device)
    if count:
        of_rays = rays.origins.detach().contiguous(), rays.directions.detach().contiguous(), field.aabb
        _locate[_programs(count)](*of_rays, *arrays, points, count, each, field.contracted, BLOCK)
    return Samples(*arrays, points, each, used)


def _programs(count: int) -> tuple[int]:
    """Return the number of programs, each of which takes a block of samples."""
    return (triton.cdiv(count, BLOCK),)


class _Joined(torch.autograd.Function):
    """The inputs of the color MLP: each sample's hidden features, and what its ray's samples share."""

    @staticmethod
    def forward(ctx: Any, hidden: Tensor, shared: Tensor, where: Samples) -> Tensor:
        ctx.width, widths = hidden.shape[1], (hidden.shape[1], shared.shape[1])
        out = hidden.new_empty(where.size, sum(widths))
        if where.size:
            width = triton.next_power_of_2(sum(widths))
            arrays = hidden.contiguous(), shared.contiguous(), where.ray_index, out
            programs = (triton.cdiv(where.size * width, 8 * BLOCK),)
            _join[programs](*arrays, where.size, *widths, where.each, width, 8 * BLOCK // width)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return grad[:, : ctx.width], None, None


class _Activated(torch.autograd.Function):
    """Density and color from raw outputs (`nerf.activations`); outside its box a field has no density."""

    @staticmethod
    def forward(
        ctx: Any, hidden: Tensor, raw: Tensor, where: Samples, field: FieldParts, whole_from: float
    ) -> tuple[Tensor, Tensor]:
        count, colored = where.size, bool(field.color_weights)
        hidden, raw = hidden.contiguous(), raw.contiguous()
        density, rgb = hidden.new_empty(count), hidden.new_empty(count, 3)
        if count:
            flags = hidden.shape[1], not field.contracted, colored, BLOCK
            _activate[_programs(count)](hidden, raw, where.points, density, rgb, field.bias, LARGEST_RAW, count, *flags)
        ctx.save_for_backward(hidden, rgb)
        ctx.where, ctx.field, ctx.whole_from = where, field, whole_from
        return density, rgb

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_density: Tensor, of_rgb: Tensor) -> tuple[Tensor | None, ...]:
        hidden, rgb = ctx.saved_tensors
        where, field = ctx.where, ctx.field
        colored = bool(field.color_weights)
        of_hidden, of_raw = torch.empty_like(hidden), torch.empty_like(rgb) if colored else rgb
        if where.size:
            arrays = hidden, where.points, rgb, of_density.contiguous(), of_rgb.contiguous(), where.starts, where.ends
            numbers = field.bias, LARGEST_SLOPE_RAW, field.least_slope, ctx.whole_from, where.size
            flags, width = (not field.contracted, colored, ctx.whole_from > 0), hidden.shape[1]
            sizes = triton.next_power_of_2(width), BLOCK
            _activate_back[_programs(where.size)](
                *arrays, of_hidden, of_raw, *numbers, where.each, width, *flags, *sizes
            )
        return of_hidden, of_raw if colored else None, None, None, None


@triton.jit
@no_type_check
def _coordinate(origins, directions, aabb, ray, t, valid, axis: tl.constexpr):
    """Return one coordinate of points on rays, as shares of the box's side."""
    low, high = tl.load(aabb + axis), tl.load(aabb + 3 + axis)
    origin = tl.load(origins + 3 * ray + axis, mask=valid, other=0.0)
    return (origin + t * tl.load(directions + 3 * ray + axis, mask=valid, other=0.0) - low) / (high - low)


@triton.jit
@no_type_check
def _locate(
    origins, directions, aabb, ray_index, starts, ends, out, count,
    each: tl.constexpr, contracted: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    sample = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = sample < count
    ray, t = midpoint(ray_index, starts, ends, sample, valid, each)
    x = _coordinate(origins, directions, aabb, ray, t, valid, 0)
    y = _coordinate(origins, directions, aabb, ray, t, valid, 1)
    z = _coordinate(origins, directions, aabb, ray, t, valid, 2)
    if (
        contracted
    ):  # `geometry.contraction`: the box's corners are on the unit sphere, and the ball of radius 2 fills the cube
        x, y, z = (2.0 * x - 1.0) / 1.7320508, (2.0 * y - 1.0) / 1.7320508, (2.0 * z - 1.0) / 1.7320508
        norm = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
        scale = 0.25 * (2.0 - 1.0 / norm) / norm
        x, y, z = x * scale + 0.5, y * scale + 0.5, z * scale + 0.5
    tl.store(out + 3 * sample, x, mask=valid)
    tl.store(out + 3 * sample + 1, y, mask=valid)
    tl.store(out + 3 * sample + 2, z, mask=valid)


@triton.jit
@no_type_check
def _join(
    hidden, shared, ray_index, out, count, own: tl.constexpr, common: tl.constexpr,
    each: tl.constexpr, width: tl.constexpr, rows: tl.constexpr,
):  # fmt: skip
    sample = (tl.program_id(0) * rows + tl.arange(0, rows)).to(tl.int64)[:, None]
    column, valid = tl.arange(0, width)[None, :], sample < count
    ray = sample // each if each > 0 else tl.load(ray_index + sample, mask=valid, other=0)
    of_sample = tl.load(hidden + sample * own + column, mask=valid & (column < own), other=0.0)
    of_ray = valid & (column >= own) & (column < own + common)
    of_ray = tl.load(shared + ray * common + column - own, mask=of_ray, other=0.0)
    total: tl.constexpr = own + common
    tl.store(out + sample * total + column, tl.where(column < own, of_sample, of_ray), mask=valid & (column < total))


@triton.jit
@no_type_check
def _activate(
    hidden, raw, points, density, rgb, bias, largest, count,
    width: tl.constexpr, boxed: tl.constexpr, colored: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    sample = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = sample < count
    sigma = tl.load(hidden + sample * width, mask=valid, other=0.0) + bias
    sigma = tl.exp(tl.minimum(sigma, largest, propagate_nan=tl.PropagateNan.ALL))
    if boxed:
        sigma = tl.where(inside(points, sample, valid), sigma, 0.0)
    tl.store(density + sample, sigma, mask=valid)
    for channel in tl.static_range(3):
        value = tl.zeros([block], tl.float32)
        if colored:
            value = tl.sigmoid(tl.load(raw + 3 * sample + channel, mask=valid, other=0.0))
        tl.store(rgb + 3 * sample + channel, value, mask=valid)


@triton.jit
@no_type_check
def _activate_back(
    hidden, points, rgb, of_density, of_rgb, starts, ends, of_hidden, of_raw,
    bias, largest, least_slope, whole_from, count,
    each: tl.constexpr, width: tl.constexpr, boxed: tl.constexpr, colored: tl.constexpr, softened: tl.constexpr,
    columns: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    sample = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = sample < count
    share = tl.full([block], 1.0, tl.float32)
    if softened:
        shift = sample // each if each > 0 else sample * 0
        t = tl.load(starts + sample + shift, mask=valid, other=0.0)
        t = 0.5 * (t + tl.load(ends + sample + shift, mask=valid, other=0.0)) / whole_from
        share = tl.minimum(t * t, 1.0)
    x = tl.load(hidden + sample * width, mask=valid, other=0.0) + bias
    slope = tl.exp(tl.minimum(tl.maximum(x, -largest), largest))
    grad = tl.load(of_density + sample, mask=valid, other=0.0) * share * slope
    if boxed:
        grad = tl.where(inside(points, sample, valid), grad, 0.0)
    # The density is the first of the hidden features; a program writes contiguous rows.
    column = tl.arange(0, columns)[None, :]
    at = of_hidden + sample[:, None] * width + column
    tl.store(at, tl.where(column == 0, grad[:, None], 0.0), mask=valid[:, None] & (column < width))
    if colored:
        for channel in tl.static_range(3):
            color = tl.load(rgb + 3 * sample + channel, mask=valid, other=0.0)
            grad = tl.load(of_rgb + 3 * sample + channel, mask=valid, other=0.0) * share
            slope = color_slope(color, grad, least_slope)
            tl.store(of_raw + 3 * sample + channel, grad * slope, mask=valid)

"""Matrix products, each in an explicit precision that nothing around a call changes.

torch lowers every float32 product inside `torch.autocast`, and on NVIDIA GPUs wherever TensorFloat-32 is allowed. A
pose multiplied in bfloat16 is wrong by half a percent. So this program uses neither: a field is given the precision of
the products with its weights (`set_precision`), and every other function that multiplies matrices is decorated with
`disable_autocast`, which holds even inside a caller's autocast.
"""

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Literal, ParamSpec, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

TILE_ROWS = 4096
"""At a width of 64, the activations of a tile take about a core's second-level cache."""
ROUND_ROWS, FEWEST_ROWS = 512, 64
AUTOCAST_DEVICES = ("cpu", "cuda", "mps", "xla")
MatmulPrecision = Literal["float32", "tf32", "bfloat16"]
"""Rounding of a product's factors: none, to 10 bits of mantissa, to 7 bits. Sums are float32."""


def disable_autocast(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function compute in the precision of its tensors, even inside a caller's autocast.

    >>> @disable_autocast
    ... def dot(left, right):
    ...     return left @ right
    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     dot(torch.tensor([1.001]), torch.tensor([1.0])).item() > 1.0
    True
    """

    @functools.wraps(function)
    def exact(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with ExitStack() as stack:
            for device in AUTOCAST_DEVICES:
                if torch.is_autocast_enabled(device):
                    stack.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return exact


@disable_autocast
def linear(
    features: Float[Tensor, "*points inputs"],
    weight: Float[Tensor, "outputs inputs"],
    bias: Float[Tensor, "outputs"] | None,
    matmul_precision: MatmulPrecision,
) -> Float[Tensor, "*points outputs"]:
    """Return features W^T + b: in bfloat16 with bfloat16 products, which halves memory traffic, else in float32."""
    if matmul_precision == "bfloat16":
        if features.is_cpu and not torch.compiler.is_compiling():
            return _LinearInTiles.apply(features, weight, bias)
        lowered = None if bias is None else bias.bfloat16()
        return functional.linear(features.bfloat16(), weight.bfloat16(), lowered)
    features = features.to(weight.dtype)  # an earlier layer may have lowered them
    if matmul_precision == "float32":
        return functional.linear(features, weight, bias)
    out = _tf32_product(features, weight.t())
    return out if bias is None else out + bias


def set_precision(module: nn.Module, matmul_precision: MatmulPrecision) -> None:
    """Set the precision of the products with the weights within a module; everything else is always float32."""
    for part in module.modules():
        if hasattr(part, "matmul_precision"):
            part.matmul_precision = matmul_precision  # type: ignore[assignment]


class Linear(nn.Linear):
    """torch's linear layer, with its own precision of the product."""

    matmul_precision: MatmulPrecision = "float32"

    def forward(self, features: Float[Tensor, "*points inputs"]) -> Float[Tensor, "*points outputs"]:
        """Return features W^T + b."""
        return linear(features, self.weight, self.bias, self.matmul_precision)


class _LinearInTiles(torch.autograd.Function):
    """features W^T + b with bfloat16 products on the CPU, in tiles of few sizes (`pad_rows`)."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        # Shapes are restored in here: on a view of the result, an in-place ReLU would copy its gradients.
        points, lowered = features.bfloat16().flatten(0, -2), weight.bfloat16()
        added = None if bias is None else bias.bfloat16()
        out = points.new_empty(*features.shape[:-1], weight.shape[0])
        flat = out.flatten(0, -2)
        for rows in tiles_of_rows(points.shape[0]):
            part = multiply(pad_rows(points[rows], torch.bfloat16), lowered.t(), added)
            flat[rows] = part[: rows.stop - rows.start]
        ctx.save_for_backward(points, lowered)
        ctx.shape = features.shape
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    @disable_autocast
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        points, weight = ctx.saved_tensors
        grad = grad.flatten(0, -2)
        of_points = torch.empty_like(points) if ctx.needs_input_grad[0] else None
        of_weight = torch.zeros(weight.shape) if ctx.needs_input_grad[1] else None
        for rows in tiles_of_rows(points.shape[0]):
            part = pad_rows(grad[rows], torch.bfloat16)
            if of_points is not None:
                of_points[rows] = multiply(part, weight)[: rows.stop - rows.start]
            if of_weight is not None:
                of_weight += multiply(part.t(), pad_rows(points[rows], torch.bfloat16))
        of_bias = grad.sum(dim=0, dtype=torch.float32) if ctx.needs_input_grad[2] else None
        return None if of_points is None else of_points.view(ctx.shape), of_weight, of_bias


@functools.cache
def cpu_multiplies_bfloat16() -> bool:
    """Return whether this CPU, as far as torch may use it (ATEN_CPU_CAPABILITY), multiplies bfloat16 natively."""
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    allowed = torch.backends.cpu.get_cpu_capability() not in ("DEFAULT", "AVX2")
    return allowed and any(map(_cpu_says, probes))


@functools.cache
def cpu_gains_by_bfloat16() -> bool:
    """Return whether torch multiplies wide matrices faster in bfloat16 than in float32 on this CPU.

    It does with AMX, and on AMD. Intel's AVX512-BF16 alone is slower than its float32 (221 instead of 331 GFLOP/s at
    256 x 256); our own kernels, which keep activations in registers, still gain there.
    """
    if not cpu_multiplies_bfloat16():
        return False
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return _cpu_says("_is_amx_tile_supported") or not str(capabilities.get("cpu_name", "")).startswith("Intel")


def _cpu_says(probe: str) -> bool:
    try:
        return bool(getattr(torch.cpu, probe, bool)())
    except (RuntimeError, NotImplementedError, OSError):  # a CPU unknown to torch has none of these
        return False


def multiply(left: Tensor, right: Tensor, added: Tensor | None = None) -> Tensor:
    """Return left @ right, plus a row; on CPUs without bfloat16 products, of bfloat16 numbers converted to float32.

    This rounds in the same places, and is many times faster than torch there.
    """
    if left.dtype == torch.bfloat16 and not cpu_multiplies_bfloat16():
        return multiply(left.float(), right.float(), None if added is None else added.float()).bfloat16()
    return left @ right if added is None else torch.addmm(added, left, right)


def tiles_of_rows(rows: int) -> list[slice]:
    """Return the slices that cut rows into tiles whose activations stay in a core's cache.

    >>> tiles_of_rows(5000)
    [slice(0, 4096, None), slice(4096, 5000, None)]
    """
    return [slice(start, min(rows, start + TILE_ROWS)) for start in range(0, rows, TILE_ROWS)]


def pad_rows(rows: Float[Tensor, "rows any"], dtype: torch.dtype) -> Float[Tensor, "padded any"]:
    """Return rows in a dtype; in bfloat16, padded with rows of zeros to one of a dozen sizes.

    The CPU's bfloat16 product is compiled for every number of rows and cached, 0.7 MB each, and the number of ragged
    samples differs each time. Without this, training used 2 GB more.

    >>> pad_rows(torch.ones(3, 2), torch.bfloat16).shape, pad_rows(torch.ones(600, 2), torch.bfloat16).shape
    (torch.Size([64, 2]), torch.Size([1024, 2]))
    """
    count = rows.shape[0]
    if dtype != torch.bfloat16:
        return rows.to(dtype)
    padded = -(-count // ROUND_ROWS) * ROUND_ROWS
    while count <= padded // 2 and padded > FEWEST_ROWS:
        padded //= 2
    if padded == count:
        return rows.to(dtype)
    out = rows.new_zeros(padded, rows.shape[1], dtype=dtype)
    out[:count] = rows
    return out


# TensorFloat-32 is a process-wide switch, read at each product, in the backward pass too. So it is set inside a single
# operation that is opaque to torch.compile.
@torch.library.custom_op("nerf_lightning::tf32_product", mutates_args=())
def _tf32_product(left: Tensor, right: Tensor) -> Tensor:
    former = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        return left @ right
    finally:
        torch.set_float32_matmul_precision(former)


@_tf32_product.register_fake
def _(left: Tensor, right: Tensor) -> Tensor:
    return left.new_empty(*left.shape[:-1], right.shape[1])


def _keep_factors(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _tf32_gradients(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
    left, right = ctx.saved_tensors
    of_left = _tf32_product(grad, right.t()) if ctx.needs_input_grad[0] else None
    rows = left.flatten(0, -2)
    return of_left, _tf32_product(rows.t(), grad.flatten(0, -2)) if ctx.needs_input_grad[1] else None


_tf32_product.register_autograd(_tf32_gradients, setup_context=_keep_factors)

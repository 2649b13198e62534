"""Matrix products, each in a precision that is asked for: nothing around a call changes it.

torch lowers every float32 product inside `torch.autocast`, and on NVIDIA GPUs wherever TensorFloat-32 is allowed. A
pose that is multiplied in bfloat16 is wrong by half a percent. So this program opens neither: a field is given the
precision of the products with its weights (`Field.multiply_in`), and every other function that multiplies matrices is
marked `own_precision`, which holds even where somebody else has opened autocast around it.
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

AUTOCAST_DEVICES = ("cpu", "cuda", "mps", "xla")
Products = Literal["float32", "tf32", "bfloat16"]
"""What the factors of a product are rounded to: not at all, to 10 bits of mantissa, to 7. Sums are float32."""


def own_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function compute in the precision that its tensors have, inside of somebody's autocast too.

    >>> @own_precision
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


@own_precision
def linear(
    features: Float[Tensor, "*points inputs"],
    weight: Float[Tensor, "outputs inputs"],
    bias: Float[Tensor, "outputs"] | None,
    products: Products,
) -> Float[Tensor, "*points outputs"]:
    """Return features W^T + b: with bfloat16 products in bfloat16, which halves the traffic, else in float32."""
    if products == "bfloat16":
        lowered = None if bias is None else bias.bfloat16()
        return functional.linear(features.bfloat16(), weight.bfloat16(), lowered)
    if products == "float32":
        return functional.linear(features, weight, bias)
    out = _tf32_product(features.flatten(0, -2), weight.t()).view(*features.shape[:-1], -1)
    return out if bias is None else out + bias


class Linear(nn.Linear):
    """torch's linear layer, whose product has a precision of its own."""

    products: Products = "float32"

    def forward(self, features: Float[Tensor, "*points inputs"]) -> Float[Tensor, "*points outputs"]:
        """Return features W^T + b."""
        return linear(features, self.weight, self.bias, self.products)


# TensorFloat-32 is a switch of the whole process, read when a product is made, in the backward pass too. So it is
# turned inside one operation, which torch.compile does not look into.
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
    return left.new_empty(left.shape[0], right.shape[1])


def _keep_factors(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _tf32_gradients(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
    left, right = ctx.saved_tensors
    of_left = _tf32_product(grad, right.t()) if ctx.needs_input_grad[0] else None
    return of_left, _tf32_product(left.t(), grad) if ctx.needs_input_grad[1] else None


_tf32_product.register_autograd(_tf32_gradients, setup_context=_keep_factors)

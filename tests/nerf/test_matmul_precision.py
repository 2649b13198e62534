"""The precision of a product is what it is asked to be, forward and backward, and nothing around it changes it."""

import pytest
import torch
from support.running import start_code
from torch.nn import functional

from nerf_lightning.nerf import matmul_precision
from nerf_lightning.nerf.matmul_precision import ROUND_ROWS, TILE_ROWS, disable_autocast, linear

# A factor that is rounded to bfloat16 (7 bits behind the leading one) is wrong by 2^-8 of itself at most; a product of
# two, summed over many terms of either sign, by less than twice that of the sum's own size.
BFLOAT16 = 2 * 2**-8


def off(found, expected):
    return float((found.double() - expected).norm() / expected.norm())


def layer(inputs=48, outputs=40, bias=True):
    torch.manual_seed(3)
    made = torch.nn.Linear(inputs, outputs, bias=bias)
    return made.weight.detach(), None if made.bias is None else made.bias.detach()


def gradients(fn, *leaves):
    leaves = [None if leaf is None else leaf.detach().clone().requires_grad_() for leaf in leaves]
    out = fn(*leaves)
    torch.manual_seed(4)
    (out * torch.randn(out.shape, dtype=torch.float64).to(out.dtype)).sum().backward()
    return [out.detach(), *(leaf.grad for leaf in leaves if leaf is not None)]


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(5,), (7, 3), (ROUND_ROWS + 1,), (2 * TILE_ROWS + 77,), (0,)])
def test_bfloat16_is_the_exact_product_up_to_its_rounding(shape, bias):
    features, (weight, bias) = torch.randn(*shape, 48), layer(bias=bias)
    found = gradients(lambda x, w, b=None: linear(x, w, b, "bfloat16"), features, weight, bias)
    in_double = [x if x is None else x.double() for x in (features, weight, bias)]
    exact = gradients(functional.linear, *in_double)
    assert found[0].dtype == torch.bfloat16
    assert all(gradient.dtype == torch.float32 for gradient in found[2:])
    for ours, expected in zip(found, exact, strict=True):
        assert ours.shape == expected.shape
        if expected.norm() > 0:
            assert off(ours, expected) < BFLOAT16
    if 0 not in shape:
        assert off(found[0], exact[0]) > 2**-12  # it was rounded


def test_a_cpu_without_bfloat16_rounds_where_one_with_it_does(monkeypatch):
    features, (weight, bias) = torch.randn(300, 48), layer()
    results = []
    for native in (matmul_precision.cpu_multiplies_bfloat16(), False):
        monkeypatch.setattr(matmul_precision, "cpu_multiplies_bfloat16", lambda native=native: native)
        results.append(gradients(lambda *x: linear(*x, "bfloat16"), features, weight, bias))
    for native, emulated in zip(*results, strict=True):
        assert native.dtype == emulated.dtype
        assert off(native, emulated.double()) < 2**-10  # sums in another order, seldom rounded to another number


def test_float32_is_torchs_own_to_the_bit():
    features, (weight, bias) = torch.randn(9, 5, 48), layer()
    ours = gradients(lambda *x: linear(*x, "float32"), features, weight, bias)
    for found, expected in zip(ours, gradients(functional.linear, features, weight, bias), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize("asked", ["float32", "tf32", "bfloat16"])
def test_autocast_around_a_product_changes_no_bit_forward_or_backward(asked):
    features, (weight, bias) = torch.randn(20, 48), layer()
    alone = gradients(lambda *x: linear(*x, asked), features, weight, bias)
    leaves = [x.clone().requires_grad_() for x in (features, weight, bias)]
    with torch.autocast("cpu", torch.bfloat16):
        out = linear(*leaves, asked)
    torch.manual_seed(4)
    (out * torch.randn(out.shape, dtype=torch.float64).to(out.dtype)).sum().backward()
    for found, expected in zip([out.detach(), *(leaf.grad for leaf in leaves)], alone, strict=True):
        assert torch.equal(found, expected)


def test_bfloat16_is_backward_what_it_is_when_the_backward_pass_is_under_autocast():
    features, (weight, bias) = torch.randn(20, 48), layer()
    results = []
    for enabled in (False, True):
        leaves = [x.clone().requires_grad_() for x in (features, weight, bias)]
        out = linear(*leaves, "bfloat16").float().square().sum()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            out.backward()
        results.append([leaf.grad for leaf in leaves])
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


def test_tf32_is_switched_on_for_its_products_alone_forward_and_backward(monkeypatch):
    seen = []
    multiply = torch.Tensor.__matmul__
    monkeypatch.setattr(
        torch.Tensor, "__matmul__", lambda a, b: seen.append(torch.get_float32_matmul_precision()) or multiply(a, b)
    )
    former = torch.get_float32_matmul_precision()
    features, (weight, bias) = torch.randn(6, 4, 48), layer()
    ours = gradients(lambda *x: linear(*x, "tf32"), features, weight, bias)
    assert seen == ["high"] * 3
    assert torch.get_float32_matmul_precision() == former == "highest"
    for found, expected in zip(ours, gradients(functional.linear, features, weight, bias), strict=True):
        torch.testing.assert_close(found, expected)  # a CPU knows no TF32


COMPILING = """
import torch
from nerf_lightning.nerf.matmul_precision import Linear
for products in ("float32", "tf32", "bfloat16"):
    made, features = Linear(48, 40), torch.randn(16, 48)
    made.matmul_precision = products
    compiled = torch.compile(made, backend="aot_eager", fullgraph=True, dynamic=False)
    torch.testing.assert_close(compiled(features), made(features), atol=1e-3, rtol=1.6e-2)
    compiled(features).float().sum().backward()
    assert made.weight.grad is not None
print("compiled")
"""


@pytest.mark.slow
def test_a_layer_compiles_in_one_piece():
    # A process of its own: torch.compile cannot look through the checks of shapes that tests switch on.
    output, errors = start_code(COMPILING).communicate(timeout=300)
    assert output == "compiled\n", errors


def test_a_function_of_its_own_precision_is_left_alone_by_autocast_and_leaves_it_as_it_was():
    @disable_autocast
    def product(left, right):
        return left @ right

    left = torch.randn(8, 8)
    with torch.autocast("cpu", torch.bfloat16):
        found = product(left, left)
        assert torch.is_autocast_enabled("cpu")
        assert (left @ left).dtype == torch.bfloat16
    assert torch.equal(found, left @ left)

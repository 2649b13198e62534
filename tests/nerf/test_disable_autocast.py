"""Autocast around any function of these rooms changes no bit of what it returns.

It lowers products of matrices alone, so whoever multiplies says in which precision: @disable_autocast, or a product of
`matmul_precision.py`.
"""

import ast
from pathlib import Path

import pytest
import torch
from support.scenes import tiny_field

import nerf_lightning
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.nerf.types.rays import Points

PACKAGE = Path(nerf_lightning.__file__).parent
ROOMS = (
    "nerf/geometry", "nerf/rendering", "nerf/samplers", "nerf/encoders", "nerf/models", "nerf/losses", "nerf/fields",
    "evaluation", "video/paths",
)  # fmt: skip
PRODUCTS = {"matmul", "mm", "bmm", "mv", "dot", "einsum", "linear", "addmm", "baddbmm", "conv2d", "tensordot", "inner"}
PRODUCTS |= {"vecdot", "multi_dot", "addbmm", "addmv", "addr", "bilinear", "scaled_dot_product_attention"}
LAYERS = {"Linear", "LazyLinear", "Bilinear", "Conv1d", "Conv2d", "Conv3d", "MultiheadAttention"}
MAY_HAVE_LAYERS = {"nerf_mlp.py"}
"""Tried below: what is marked there is the call of its layers."""


def multiplies(node: ast.AST, layers: set[str]) -> bool:
    if isinstance(node, ast.BinOp | ast.AugAssign):
        return isinstance(node.op, ast.MatMult)
    # Torch's are attributes (torch.mm, functional.linear); a plain name is one of matmul_precision.py.
    return isinstance(node, ast.Call) and getattr(node.func, "attr", "") in PRODUCTS | layers


def unmarked_products(text: str, layers: set[str]) -> list[int]:
    """The lines that multiply matrices in functions that are not marked."""
    tree = ast.parse(text)
    marked = {
        inner
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef)
        and any(getattr(mark, "id", "") == "disable_autocast" for mark in outer.decorator_list)
        for inner in ast.walk(outer)
    }
    return sorted(node.lineno for node in ast.walk(tree) if multiplies(node, layers) and node not in marked)


@pytest.mark.parametrize("room", ROOMS)
def test_who_multiplies_matrices_says_in_which_precision(room):
    for file in sorted((PACKAGE / room).rglob("*.py")):
        found = unmarked_products(file.read_text(encoding="utf-8"), set() if file.name in MAY_HAVE_LAYERS else LAYERS)
        assert not found, f"{file}, lines {found}: mark the function @disable_autocast"


def test_nothing_opens_autocast():
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8").replace("disable_autocast", "")
        assert file.name == "matmul_precision.py" or "autocast" not in text, f"{file}: see matmul_precision.py"


def under_autocast_and_not(call) -> list:
    with torch.no_grad():
        plain = call()
        with torch.autocast("cpu", torch.bfloat16):
            return [plain, call()]


def test_an_mlp_and_metrics_are_the_same_under_autocast():
    field, points = tiny_field(), Points(torch.rand(8, 5, 3), torch.rand(8, 1, 3))
    plain, lowered = under_autocast_and_not(lambda: field(points))
    assert torch.equal(plain.rgb, lowered.rgb)
    assert torch.equal(plain.density, lowered.density)
    truth, render = torch.rand(48, 48, 3), torch.rand(48, 48, 3)
    plain, lowered = under_autocast_and_not(lambda: image_metrics(render, truth))
    assert plain == lowered

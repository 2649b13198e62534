"""Whatever of ours a test calls is checked: arguments, results, and that axes of one name have one size."""

import sys
import types
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from support import type_checks
from support.type_checks import checked
from torch import Tensor

from nerf_lightning.nerf.rendering.quadrature import weights_from_density


def decorated(function):
    return checked(typechecker=beartype)(function)


@decorated
def summed(
    points: Float[Tensor, "*rays samples 3"], weights: Float[Tensor, "*rays samples"]
) -> Float[Tensor, "*rays 3"]:
    return (points * weights[..., None]).sum(-2) if weights.shape[-1] > 1 else points


def test_axes_of_one_name_have_one_size_within_a_call_also_in_what_is_returned_and_any_in_the_next():
    assert summed(torch.ones(2, 5, 3), torch.ones(2, 5)).shape == (2, 3)
    assert summed(torch.ones(7, 4, 6, 3), torch.ones(7, 4, 6)).shape == (7, 4, 3)
    with pytest.raises(TypeCheckError, match="weights"):
        summed(torch.ones(2, 5, 3), torch.ones(2, 4))
    with pytest.raises(TypeCheckError, match="points"):
        summed(torch.ones(2, 5, 3, dtype=torch.int64), torch.ones(2, 5))
    with pytest.raises(TypeCheckError, match="return"):
        summed(torch.ones(2, 1, 3), torch.ones(2, 1))
    with pytest.raises(TypeCheckError, match="deltas"):
        weights_from_density(torch.ones(4, 3), torch.ones(4, 2))


def test_all_of_ours_are_checked_so():
    """The fault: what a conftest.py imports was decorated before, by jaxtyping itself."""
    loaded = [module for name, module in sys.modules.items() if name.startswith("nerf_lightning.")]
    ours = [each for module in loaded for each in vars(module).values() if isinstance(each, types.FunctionType)]
    decorators = {Path(each.__code__.co_filename).name for each in ours}
    assert Path(type_checks.__file__).name in decorators
    assert "_decorator.py" not in decorators


def test_a_dataclass_is_checked_when_it_is_made():
    @checked(typechecker=beartype)
    @dataclass(frozen=True)
    class Pair:
        one: Float[Tensor, " n"]
        other: Float[Tensor, " n"]
        name: str = ""

    Pair(torch.ones(3), torch.ones(3), "a")
    with pytest.raises(TypeCheckError, match="other"):
        Pair(torch.ones(3), torch.ones(2))
    with pytest.raises(TypeCheckError, match="name"):
        Pair(torch.ones(3), torch.ones(3), 3)


def test_what_passed_once_passes_again_and_nothing_else_does():
    calls = []

    @decorated
    def parts(values: Float[Tensor, " n"], kind: str, more: Float[Tensor, " n"]) -> tuple[Float[Tensor, " n"], str]:
        calls.append(kind)
        return (values, kind) if kind == "right" else (more[1:], kind)

    for _ in range(2):
        assert len(parts(torch.ones(3), "right", torch.ones(3))) == 2
        with pytest.raises(TypeCheckError, match="return"):
            parts(torch.ones(3), "wrong", torch.ones(3))
        with pytest.raises(TypeCheckError, match="more"):
            parts(torch.ones(3), "right", torch.ones(2))
    assert calls == 2 * ["right", "wrong"]

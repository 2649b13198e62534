"""Whatever of ours a test calls is checked: arguments, results, and that axes of one name have one size."""

import sys
import types
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

"""Parameter groups: tables do not decay, and parts may have their own learning rates.

The rates: `lr` in conf/optimizer/, `learning_rate` in conf/refinement/ and conf/correction/.
"""

from collections.abc import Callable, Iterable
from typing import Any

from torch import nn
from torch.optim import Optimizer

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.base import tables_of
from nerf_lightning.nerf.part import parts_of

BuildOptimizer = Callable[[Iterable[Any]], Optimizer]


def optimizer_of(module: nn.Module, build: BuildOptimizer) -> Optimizer:
    """Return the optimizer of all parameters; the encoders' tables and parts with their own rate do not decay.

    Raises:
        InputError: the optimizer refuses a setting.
    """
    tables = tables_of(module)
    groups: list[dict[str, Any]] = [{"params": tables, "weight_decay": 0.0}] if tables else []
    known = set(map(id, tables))
    for part in parts_of(module):
        own = [parameter for parameter in part.parameters() if id(parameter) not in known]
        if own and part.learning_rate is not None:
            groups.append({"params": own, "weight_decay": 0.0, "lr": part.learning_rate})
            known |= set(map(id, own))
    groups.insert(0, {"params": [each for each in module.parameters() if id(each) not in known]})
    try:
        return build(groups)
    except (ValueError, TypeError) as error:  # torch checks its settings here
        raise InputError(f"The optimizer refuses its settings: {error}. Fix optimizer.*, or leave it out.") from error

"""Which classes a stranger's checkpoint may name: parts of models, from our own rooms, that follow a contract."""

import importlib
from typing import Any

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.samplers.base import Sampler

CONTRACTS = (Encoder, Field, Sampler, Level, Model)
ROOMS = tuple(f"nerf_lightning.nerf.{room}." for room in ("encoders", "fields", "samplers", "models"))
LARGEST_NUMBER = 1 << 53


def require_trusted(node: Any, source: str) -> None:
    """Look through a model's config from a file, before anything is built of it.

    Args:
        node: the config, or a part of it.
        source: the file, for the message.

    Raises:
        InputError: it names what is no part of a model of ours, or holds what no config of ours does.
    """
    if isinstance(node, list):
        for child in node:
            require_trusted(child, source)
    elif isinstance(node, (int, float)) and not abs(node) <= LARGEST_NUMBER:
        raise InputError(f"{source}: its model part holds the number {node:.3g}, which no model has. Use another one.")
    elif isinstance(node, str):
        if "${" in node:
            raise InputError(f"{source}: its model part holds an interpolation ({node}), which is not read from files.")
    elif isinstance(node, dict):
        for key, child in node.items():
            if key == "_target_":
                _require_contract(child, source)
            elif str(key).startswith("_"):
                raise InputError(f"{source}: its model part holds the key {key}, which is not read from files.")
            else:
                require_trusted(child, source)


def _require_contract(target: Any, source: str) -> None:
    module_name, _, class_name = str(target).rpartition(".")
    found = None
    if module_name.startswith(ROOMS):
        try:
            found = getattr(importlib.import_module(module_name), class_name, None)
        except ImportError:
            found = None
    ours = isinstance(found, type) and issubclass(found, CONTRACTS) and found.__module__ == module_name
    if not ours:
        raise InputError(
            f"{source} asks for {target}, which is not a model part of this program, so it is not built. Use a "
            "checkpoint from a source that you trust, or install the version that has this class."
        )

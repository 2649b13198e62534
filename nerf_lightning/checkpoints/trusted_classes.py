"""Which classes a stranger's checkpoint may name: parts of models and corrections of ours that follow a contract.

A person adds modules of their own with `trust=`; no file can.
"""

import importlib
from collections.abc import Iterator, Sequence
from typing import Any

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.samplers.base import Sampler

CONTRACTS = (Encoder, Field, Sampler, Level, Model, Correction)
ROOMS = (
    *(f"nerf_lightning.nerf.{room}." for room in ("encoders", "fields", "samplers", "models", "corrections")),
    "nerf_lightning.extensions.",
)
LARGEST_NUMBER = 1 << 53


def require_trusted(node: Any, source: str, trusted: Sequence[str] = ()) -> None:
    """Look through a model's config from a file, before anything is built of it.

    Args:
        node: the config, or a part of it.
        source: the file, for the message.
        trusted: modules of the person's own, with all below them, whose parts may be built, too.

    Raises:
        InputError: it names what is no part of a model of ours, or holds what no config of ours does.
    """
    if isinstance(node, list):
        for child in node:
            require_trusted(child, source, trusted)
    elif isinstance(node, (int, float)) and not abs(node) <= LARGEST_NUMBER:
        raise InputError(f"{source}: its model part holds the number {node:.3g}, which no model has. Use another one.")
    elif isinstance(node, str):
        if "${" in node:
            raise InputError(f"{source}: its model part holds an interpolation ({node}), which is not read from files.")
    elif isinstance(node, dict):
        for key, child in node.items():
            if key == "_target_":
                _require_contract(child, source, trusted)
            elif str(key).startswith("_"):
                raise InputError(f"{source}: its model part holds the key {key}, which is not read from files.")
            else:
                require_trusted(child, source, trusted)


def modules_to_trust(node: Any) -> list[str]:
    """Return the modules of the parts in a person's own config that are none of this program, each once.

    >>> modules_to_trust({"_target_": "my_parts.Model", "field": {"_target_": "nerf_lightning.nerf.fields.x.Field"}})
    ['my_parts']
    """
    return list(dict.fromkeys(_foreign(node)))


def _foreign(node: Any) -> Iterator[str]:
    if isinstance(node, dict) and not str(node.get("_target_", ROOMS[0])).startswith(ROOMS):
        yield str(node["_target_"]).rpartition(".")[0]
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from _foreign(child)


def _require_contract(target: Any, source: str, trusted: Sequence[str]) -> None:
    module_name, _, class_name = str(target).rpartition(".")
    is_trusted = any(f"{module_name}.".startswith(f"{each}.") for each in trusted)
    found = None
    if module_name.startswith(ROOMS) or is_trusted:
        try:
            found = getattr(importlib.import_module(module_name), class_name, None)
        except ImportError as error:
            if is_trusted:
                raise InputError(
                    f"{source} asks for {target}, which is trusted (trust={module_name}), but cannot be imported: "
                    f"{error}. Name the folder that holds it: PYTHONPATH=FOLDER nerf ..."
                ) from error
    if not (isinstance(found, type) and issubclass(found, CONTRACTS) and found.__module__ == module_name):
        raise InputError(
            f"{source} asks for {target}, which is not a model part of this program, so it is not built. If it is your "
            f"own, add trust={module_name}; otherwise use a checkpoint from a source that you trust, or install the "
            "version that has this class."
        )

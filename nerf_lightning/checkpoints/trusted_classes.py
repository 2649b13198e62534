"""Which classes an untrusted checkpoint may name: our parts of models and corrections that follow a contract.

The user adds other modules with `trust=`; no file can.

What the pickle in a checkpoint may build: GLOBALS in `files/tensor_files.py`.
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
    """Check a model's config from a file, before anything is built from it.

    Args:
        node: the config, or a part of it.
        source: the file, for the message.
        trusted: the user's modules, including submodules, whose parts may also be built.

    Raises:
        InputError: it names something that is not a part of this program's models, or holds what none of its configs
            does.
    """
    for key, value in _settings(node):
        if key == "_target_":
            _require_contract(str(value), source, trusted)
        elif key.startswith("_") or (isinstance(value, str) and "${" in value):
            raise InputError(f"{source}: its model part holds {key}: {value}, which is not read from files.")
        elif isinstance(value, (int, float)) and not abs(value) <= LARGEST_NUMBER:
            raise InputError(f"{source}: its model part holds the number {value:.3g}, which no model has.")


def names_of(trusted: Sequence[str]) -> list[str]:
    """Return the name patterns of all parts that may be built from a file, for Hydra to enforce.

    >>> names_of(["my_parts"])[-2:]
    ['nerf_lightning.extensions.*', 'my_parts.*']
    """
    return [f"{room}*" for room in (*ROOMS, *(f"{each}." for each in trusted))]


def modules_to_trust(node: Any) -> list[str]:
    """Return the modules of the parts in the user's config that do not belong to this program, each once.

    >>> modules_to_trust({"_target_": "my_parts.Model", "field": {"_target_": "nerf_lightning.nerf.fields.x.Field"}})
    ['my_parts']
    """
    targets = [str(value) for key, value in _settings(node) if key == "_target_"]
    return list(dict.fromkeys(target.rpartition(".")[0] for target in targets if not target.startswith(ROOMS)))


def _settings(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each key of a config with its value, including sections and lists; items of a list have the list's key."""
    for name, value in node.items() if isinstance(node, dict) else ((key, each) for each in node):
        yield str(name), value
        if isinstance(value, (dict, list)):
            yield from _settings(value, str(name))


def _require_contract(target: str, source: str, trusted: Sequence[str]) -> None:
    module_name, _, class_name = target.rpartition(".")
    is_trusted = any(f"{module_name}.".startswith(f"{each}.") for each in trusted)
    part = None
    if module_name.startswith(ROOMS) or is_trusted:
        try:
            part = getattr(importlib.import_module(module_name), class_name, None)
        except ImportError as error:
            if is_trusted:
                raise InputError(
                    f"{source} asks for {target}, which is trusted (trust={module_name}), but cannot be imported: "
                    f"{error}. Name the folder that holds it: PYTHONPATH=FOLDER nerf ..."
                ) from error
    if not (isinstance(part, type) and issubclass(part, CONTRACTS) and part.__module__ == module_name):
        raise InputError(
            f"{source} asks for {target}, which is not a model part of this program, so it is not built. If it is your "
            f"own, add trust={module_name}; otherwise use a checkpoint from a source that you trust, or install the "
            "version that has this class."
        )

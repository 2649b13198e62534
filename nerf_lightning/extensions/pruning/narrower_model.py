"""The config of a checkpoint with narrower fields, so that its readers build them."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import yaml

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.config.load_model import build_model
from nerf_lightning.files.yaml_files import plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model


def widths_of(checkpoint: Checkpoint, fields: Sequence[str]) -> dict[str, int]:
    """Return the width of each field of the model in a checkpoint's config.

    Raises:
        InputError: it has no width.
    """
    config = _config(checkpoint)
    return {field: _node(config, field, checkpoint)["width"] for field in fields}


def with_widths(checkpoint: Checkpoint, widths: Mapping[str, int]) -> str:
    """Return the config of a checkpoint, as text, with other widths for its model's fields.

    The section `field`, from which most of them are composed, takes the width of the last one that was as wide.
    """
    config = _config(checkpoint)
    wider = copy.deepcopy(config)
    for field, width in widths.items():
        node, before = _node(config, field, checkpoint), _node(wider, field, checkpoint)["width"]
        node["width"] = width
        composed = config.get("field")
        if isinstance(composed, dict) and wider["field"].get("width") == before:
            composed["width"] = width
    return yaml.safe_dump(config, sort_keys=False)


def shapes_of(checkpoint: Checkpoint, config: str, trusted: Sequence[str]) -> Model:
    """Return the model that a changed config describes, without memory."""
    with torch.device("meta"):
        return build_model(plain_yaml(config, "The narrower config")["model"], checkpoint, trusted)


def _config(checkpoint: Checkpoint) -> dict[str, Any]:
    return plain_yaml(checkpoint.config, f"The config in {checkpoint.path}")  # a dictionary: its model has been built


def _node(config: dict[str, Any], field: str, checkpoint: Checkpoint) -> dict[str, Any]:
    node: Any = config["model"]
    for name in field.split("."):
        node = node.get(name) if isinstance(node, dict) else None
    if not isinstance(node, dict) or not isinstance(node.get("width"), int):
        raise InputError(
            f"The config in {checkpoint.path} has no model.{field}.width, which says how wide that field is, so a "
            "narrower one could not be built from the file. Pruning supports fields like nerf_mlp and ngp."
        )
    return node

"""Build a model from a checkpoint's config, using only our own classes and those that the user trusts."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from hydra.errors import HydraException

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.checkpoints.trusted_classes import names_of, require_trusted
from nerf_lightning.config.hydra_versions import instantiate
from nerf_lightning.config.instantiate import require_fitting_values
from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.yaml_files import plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.encoders.base import Encoder, matrices_of
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.samplers.base import Sampler

SPARE_NUMBERS = 1 << 24  # Maximum that a model may hold besides its weights


def load_model(checkpoint: Checkpoint, trusted: Sequence[str] = ()) -> Model:
    """Build the model that a checkpoint describes, with its weights, in evaluation mode.

    The config in a checkpoint is untrusted: only its `model` part is read, and only classes are built that follow one
    of our contracts and are defined in our own packages, or in modules that the user trusts (`trusted`, including their
    submodules).

    Raises:
        InputError: the config names anything else, or the weights do not fit.
    """
    config = _config_of(checkpoint, "model", trusted)
    # First without memory: untrusted sizes must match the weights that come with them.
    with torch.device("meta"):
        shapes = build_model(config, checkpoint, trusted)
    asked = sum(tensor.numel() for tensor in (*shapes.parameters(), *shapes.buffers()))
    held = sum(tensor.numel() for tensor in checkpoint.weights.values())
    if asked > held + SPARE_NUMBERS:
        raise InputError(
            f"{checkpoint.path} is damaged: its config describes a model of {asked:,} numbers, and its weights are "
            f"{held:,}. Use another checkpoint."
        )
    model = build_model(config, checkpoint, trusted)
    checkpoint.load_weights(model)
    hold_to_budgets(model, f"The model of {checkpoint.path}")
    # Per point, in any layer or at the end of any encoder.
    sides = [max(matrix.shape) for matrix in matrices_of(model)]
    encoded = [part.out_dim for part in model.modules() if isinstance(part, Encoder)]
    widest = max([*sides, *encoded], default=0)
    require_within("layer_width", widest, f"The model of {checkpoint.path}", "features of one point in a layer")
    return model.eval()


def load_correction(checkpoint: Checkpoint, trusted: Sequence[str] = ()) -> Correction:
    """Build the correction that a checkpoint describes, with what it learned per photograph, as `load_model` does.

    Raises:
        InputError: the config names anything else, or the weights do not fit.
    """
    config = _config_of(checkpoint, "correction", trusted)
    correction = _built(config, "correction", checkpoint, trusted)
    if not isinstance(correction, Correction):
        kind = type(correction).__name__
        raise InputError(f"{checkpoint.path}: its correction part describes a {kind}, not a correction.")
    correction.fit_to(checkpoint.scene)
    checkpoint.load_correction(correction)
    return correction.eval()


def _config_of(checkpoint: Checkpoint, part: str, trusted: Sequence[str]) -> dict[str, Any]:
    config = plain_yaml(checkpoint.config, f"The config in {checkpoint.path}")
    if not isinstance(config, dict) or not isinstance(config.get(part), dict):
        raise InputError(f"{checkpoint.path} is damaged: its config has no readable {part} part. Use another one.")
    found: dict[str, Any] = config[part]
    require_trusted(found, str(checkpoint.path), trusted)
    return found


def hold_to_budgets(model: Model, where: str) -> None:
    """Refuse a model that evaluates more points of a ray at once than the user allows; bound its marches.

    `where` is its origin, for the message.
    """
    for part in model.modules():
        if isinstance(part, Sampler):
            part.max_intervals = limits().intervals
    if not model.level_names:
        raise InputError(f"{where} has no level (model.levels is empty); at least one is needed.")
    require_within("samples_per_ray", math.ceil(model.points_per_ray(training=True)), where, "samples along a ray")


def build_model(config: dict[str, Any], checkpoint: Checkpoint, trusted: Sequence[str]) -> Model:
    """Build the model part of a checkpoint's config, which has been checked (`require_trusted`)."""
    model = _built(config, "model", checkpoint, trusted)
    if not isinstance(model, Model):
        raise InputError(f"{checkpoint.path}: its model part describes a {type(model).__name__}, not a model.")
    return model


def _built(config: dict[str, Any], part: str, checkpoint: Checkpoint, trusted: Sequence[str]) -> Any:
    try:
        require_fitting_values(config, part)
        return instantiate(config, names_of(trusted))
    except HydraException as error:
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise InputError(f"{checkpoint.path}: its {part} part cannot be built: {reason}. Use another one.") from error

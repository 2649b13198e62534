"""What `nerf train` chooses for a scene where the user leaves it open: model, time, what comes before and after.

Each choice is said in one line, with the setting that makes another.
"""

import copy
import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.config.compose import chosen, compose_config
from nerf_lightning.data.captures.extent import PHOTOGRAPHS, grid_for, model_for
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.exposure import Exposure
from nerf_lightning.nerf.types.scene import Scene

AUTO = "auto"
EXPOSURE = f"{Exposure.__module__}.{Exposure.__name__}"
PHOTOS_SECONDS = 300
"""Of training on photographs alone: with their cameras, evaluation and film about ten minutes on two cores."""

log = logging.getLogger(__name__)


def resolve_auto(
    config: DictConfig, choices: Mapping[str, Any], overrides: Sequence[str], scene: Scene
) -> tuple[DictConfig, dict[str, str]]:
    """Return the config in which nothing is left open, and the names picked from each group.

    `choices` are those picked so far, and `overrides` what the config was composed with.

    Raises:
        InputError: a setting that is neither a value nor auto.
    """
    config = copy.deepcopy(config)
    if choices.get("model") == AUTO:
        name, reason = model_for(scene)
        log.info("model: %s, since %s (model=NAME chooses another)", name, reason)
        with_model = [*overrides, f"model={name}"]
        fitted, picked = compose_config("train", with_model)
        if name == PHOTOGRAPHS and scene.depths is not None and picked["loss"] == "proposal":
            fitted, picked = compose_config("train", [*with_model, *_for_depths(scene, overrides)])
        fitted.paths = config.paths
        config, choices = fitted, picked
    of_photos = choices.get("scene") == "photos"
    _settle(config, "doctor", of_photos)
    _settle(config.final, "report", of_photos)
    if config.budget.seconds == AUTO:
        config.budget.seconds = PHOTOS_SECONDS if of_photos else None
        if of_photos:
            log.info("budget: %s of training (budget.seconds=N)", spoken(PHOTOS_SECONDS))
    return config, chosen(choices)


def _for_depths(scene: Scene, overrides: Sequence[str]) -> list[str]:
    """Return the loss and the grid that suit known depths; what a person has typed stays."""
    typed = {re.split("[.=@]", override.lstrip("+~"))[0] for override in overrides}
    if "loss" in typed or scene.depths is None:
        return []
    log.info(
        "loss: depth, since the distance of %s pixels is known (loss=proposal takes no notice)",
        f"{len(scene.depths):,}",
    )
    if "encoder" in typed:
        return ["loss=depth"]
    resolution, table = grid_for(scene)
    log.info("encoder: %d cells a side, as small as the pixels (encoder.max_resolution=N)", resolution)
    return ["loss=depth", f"encoder.max_resolution={resolution}", f"encoder.log2_table_size={table}"]


def resolve_correction(
    config: DictConfig,
    choices: Mapping[str, Any],
    overrides: Sequence[str],
    finding: str | None = None,
    former: Mapping[str, Any] | None = None,
) -> tuple[DictConfig, dict[str, str]]:
    """Return the config and the names picked from each group, with the correction that the photographs want.

    `finding` is what the doctor says of their exposure, None: nothing. A run that is gone on with (`former`: its
    config) keeps the one that was chosen for it.
    """
    picked = chosen(choices)
    if picked.get("correction") != AUTO:
        return config, picked
    if former is None:
        cause = finding
    else:
        section = former.get("correction")
        kept = isinstance(section, dict) and section.get("_target_") == EXPOSURE
        cause = "the run began with it" if kept else None
    picked["correction"] = "exposure" if cause else "none"
    if cause:
        log.info("correction: exposure, since %s (correction=none takes the colours as they are)", cause)
        config = copy.deepcopy(config)
        config.correction = compose_config("train", [*overrides, "correction=exposure"])[0].correction
    return config, picked


def _settle(section: DictConfig, key: str, value: bool) -> None:
    meant = {AUTO: value, "on": True, "off": False, True: True, False: False}
    if section[key] not in meant:
        raise InputError(f"{key}={section[key]} does not fit: it must be on, off or auto.")
    section[key] = meant[section[key]]

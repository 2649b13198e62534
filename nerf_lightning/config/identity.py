"""Which settings make a run what it is, and whether a run of given settings is already there."""

import copy
import hashlib
import json
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.overrides import flatten

# Where a run lies, how long it lasts, what is said of it and what happens after it do not make it another run.
NOT_IDENTITY = (
    *("paths.", "resume", "sweep.", "trainer.max_steps", "trainer.max_epochs", "trainer.val_every_steps"),
    "trainer.lightning",
    *("logger.", "evaluation.", "final.", "path.", "callbacks.", "viewer.", "scene.cache_dir", "scene.verify"),
    *("scene.allow_outside", "scene.max_gigabytes", "budgets."),
)
IDENTITY = ("callbacks.collapse_guard.",)
# What may differ between two starts of which the second has nothing left to do.
OF_ONE_START = ("paths.", "resume", "sweep.", "logger.", "viewer", "scene.cache_dir", "budgets.")
# What viewer=off leaves of its group: a run that is watched is the same run.
UNWATCHED: dict[str, Any] = {"viewer": {}}


def run_identity(config: DictConfig) -> dict[str, Any]:
    """Return the settings that make a run what it is: two of the same identity and length compute the same."""
    return {key: value for key, value in flatten(config).items() if is_identity(key)} | UNWATCHED


def is_identity(key: str) -> bool:
    """Tell whether a setting makes a run what it is."""
    return key.startswith(IDENTITY) or not key.startswith(NOT_IDENTITY)


def fingerprint(identity: dict[str, Any]) -> str:
    """Return a short name of an identity."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:16]


def settings_digest(config: DictConfig) -> str:
    """Return a short name of everything that a run does, its length and its evaluation included."""
    resolved = copy.deepcopy(config)
    OmegaConf.resolve(resolved)
    kept = {key: value for key, value in flatten(resolved).items() if not key.startswith(OF_ONE_START)}
    return fingerprint(kept | UNWATCHED)

"""Identity of runs: the settings that define it, and their fingerprints."""

import copy
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.overrides import flatten
from nerf_lightning.config.setting_rules import fingerprint, meaning_of


def run_identity(config: DictConfig) -> dict[str, Any]:
    """Return the settings that define a run: two with the same identity and length compute the same."""
    return {key: value for key, value in flatten(config).items() if meaning_of(key).identity}


def settings_digest(config: DictConfig) -> str:
    """Return a fingerprint of everything that a run does, including its length and its evaluation."""
    resolved = copy.deepcopy(config)
    OmegaConf.resolve(resolved)
    return fingerprint({key: value for key, value in flatten(resolved).items() if meaning_of(key).outcome})

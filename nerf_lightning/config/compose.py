"""Compose a command's config without a command line, such as for a notebook."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.initialize import initialize_config_dir
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.hydra_versions import DEFAULTS
from nerf_lightning.config.instantiate import require_kinds
from nerf_lightning.config.overrides import key_of
from nerf_lightning.config.search_path import search_extensions
from nerf_lightning.files.folders import conf_folder


@dataclass(frozen=True)
class Composed:
    """A command's config, with what it was composed from: the program adds what the user leaves open."""

    command: str
    config: DictConfig
    choices: Mapping[str, str]
    """The name picked from each group."""
    overrides: Sequence[str] = ()
    resumed: Mapping[str, Any] | None = None
    """The config of the run that is resumed, whose choices are kept; untrusted. None: there is none."""

    @property
    def typed(self) -> set[str]:
        """The settings that the overrides name."""
        return set(map(key_of, self.overrides))

    def with_setting(self, key: str, value: object) -> "Composed":
        """Return this with one value replaced."""
        config = copy.deepcopy(self.config)
        OmegaConf.update(config, key, value, merge=False)
        return replace(self, config=config)

    def composed_with(self, overrides: Sequence[str]) -> "Composed":
        """Return the config composed anew, with more overrides; they do not count as typed."""
        anew = compose_config(self.command, [*self.overrides, *overrides])
        return replace(self, config=anew.config, choices=anew.choices)


def compose_config(command: str, overrides: Sequence[str]) -> Composed:
    """Return the config that `nerf COMMAND OVERRIDES` would have.

    Raises:
        InputError: an override cannot be read, or names something that does not exist.
    """
    config = _composed(command, overrides)
    choices = picked(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    return Composed(command, config, choices, overrides)


@contextmanager
def composed_job(command: str, overrides: Sequence[str]) -> Iterator[DictConfig]:
    """Provide a command's config, and Hydra's own where the command looks for it, so that it can run here."""
    config = _composed(command, overrides)
    job = HydraConfig.instance()
    former = job.cfg
    job.set_config(config)
    try:
        with open_dict(config):
            del config["hydra"]
        yield config
    finally:
        job.cfg = former


def _composed(command: str, overrides: Sequence[str]) -> DictConfig:
    """Return a command's config with Hydra's own."""
    with in_words(command), _hydra():
        config = compose(command, overrides=list(overrides), return_hydra_config=True)
        require_kinds(config, command)
    return config


def picked(choices: Mapping[str, Any]) -> dict[str, str]:
    """Return the names picked from each group, without groups from which none was picked."""
    return {key: value for key, value in choices.items() if isinstance(value, str)}


@contextmanager
def _hydra() -> Iterator[None]:
    """Let Hydra compose from our conf/, and restore another Hydra application, which may have called us."""
    former = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    search_extensions()
    try:
        with initialize_config_dir(str(conf_folder()), **DEFAULTS):
            yield
    finally:
        GlobalHydra.instance().hydra = former  # Hydra puts a copy of the holder in place

"""Composing the yaml files of conf/ in tests."""

import copy
from functools import cache
from pathlib import Path

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.initialize import initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.files.folders import conf_folder


def options(group: str) -> list[str]:
    """Return the names that a config group offers."""
    return sorted(file.stem for file in (conf_folder() / group).glob("*.yaml"))


def composed(command: str, *overrides: str) -> DictConfig:
    """Return the config of a command."""
    return copy.deepcopy(_composed(command, overrides))


@cache
def _composed(command: str, overrides: tuple[str, ...]) -> DictConfig:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return compose(command, overrides=list(overrides))


def loaded(group: str, option: str) -> DictConfig:
    """Return one yaml as it stands, with the settings that it takes from one of conf/ itself (`/capture@_here_`)."""
    config = OmegaConf.load(Path(conf_folder()) / group / f"{option}.yaml")
    for base in [str(each) for each in config.get("defaults", []) if str(each).endswith("@_here_")]:
        config.defaults.remove(base)
        name = base.removeprefix("/").removesuffix("@_here_")
        config = OmegaConf.merge(OmegaConf.load(conf_folder() / f"{name}.yaml"), config)
    assert isinstance(config, DictConfig)
    return config

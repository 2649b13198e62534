"""Composing the yaml files of conf/ in tests."""

import copy
from functools import cache
from pathlib import Path

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.initialize import initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.hydra_versions import DEFAULTS
from nerf_lightning.config.search_path import search_extensions
from nerf_lightning.files.folders import conf_file, conf_folder, conf_folders, option_names


def options(group: str) -> list[str]:
    """Return the names that a config group offers."""
    return option_names(group)


def yaml_files() -> list[Path]:
    """Return every yaml file, ours and extensions'."""
    return [file for folder in conf_folders() for file in folder.rglob("*.yaml")]


def groups() -> list[str]:
    """Return the names of all config groups."""
    return sorted({folder.name for conf in conf_folders() for folder in conf.iterdir() if folder.is_dir()})


def composed(command: str, *overrides: str) -> DictConfig:
    """Return the config of a command."""
    return copy.deepcopy(_composed(command, overrides))


@cache
def _composed(command: str, overrides: tuple[str, ...]) -> DictConfig:
    GlobalHydra.instance().clear()
    search_extensions()
    with initialize_config_dir(str(conf_folder()), **DEFAULTS):
        return compose(command, overrides=list(overrides))


def loaded(group: str, option: str) -> DictConfig:
    """Return one yaml as it stands, with the settings that it includes (`/scene_defaults@_here_`)."""
    config = OmegaConf.load(conf_file(f"{group}/{option}"))
    for base in [str(each) for each in config.get("defaults", []) if str(each).endswith("@_here_")]:
        config.defaults.remove(base)
        name = base.removeprefix("/").removesuffix("@_here_")
        config = OmegaConf.merge(OmegaConf.load(conf_file(name)), config)
    assert isinstance(config, DictConfig)
    return config

"""Hydra's compositions of our conf/, each made once a process: the tests make some thousands, mostly of the same files.

Which files are merged, and what they give, follows from the command and from the groups picked; only that is kept. The
overrides of single settings are applied by Hydra each time. Processes that start from nothing compose without this.
"""

import pickle
from pathlib import Path

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, Overrides, create_defaults_list
from hydra._internal.hydra import Hydra
from hydra.core.default_element import ResultDefault
from hydra.plugins.config_source import ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig

CONF = f"file://{Path(__file__).parents[2] / 'conf'}"

composed_mode = Hydra.get_mode
merged = ConfigLoaderImpl._compose_config_from_defaults_list

_lists: dict[str, DefaultsList] = {}
_configs: dict[str, bytes] = {}


class Known(list[ResultDefault]):
    """The files to merge, and which picks they follow from."""

    key: str


def install() -> None:
    """Let Hydra compose so in this process."""
    Hydra.get_mode = mode_as_typed
    config_loader_impl.create_defaults_list = files_to_merge
    ConfigLoaderImpl._compose_config_from_defaults_list = merged_once


def mode_as_typed(hydra: Hydra, config_name: str | None, overrides: list[str]) -> RunMode | None:
    """Return what Hydra's own `get_mode` does: our conf/ sets no mode, so that only an override could.

    Hydra composes the whole config a first time for it.
    """
    return composed_mode(hydra, config_name, overrides) if "hydra.mode" in str(overrides) else None


def files_to_merge(repo, config_name, overrides_list, prepend_hydra, skip_missing) -> DefaultsList:
    """Return what Hydra's `create_defaults_list` does; of files of others nothing is kept."""
    arguments = dict(config_name=config_name, prepend_hydra=prepend_hydra, skip_missing=skip_missing)
    if not all(map(_stays, repo.get_sources())):
        return create_defaults_list(repo=repo, overrides_list=overrides_list, **arguments)
    picked = Overrides(repo=repo, overrides_list=overrides_list)
    key = repr((arguments, picked.override_choices, picked.append_group_defaults, picked.deletions))
    if key not in _lists:
        found = create_defaults_list(repo=repo, overrides_list=overrides_list, **arguments)
        found.defaults = Known(found.defaults)
        found.defaults.key = key
        _lists[key] = found
    kept = _lists[key]
    return DefaultsList(kept.defaults, kept.defaults_tree, picked.config_overrides, kept.overrides)


def merged_once(loader: ConfigLoaderImpl, defaults: list[ResultDefault], repo) -> DictConfig:
    """Return what Hydra makes of these files, a copy each time."""
    if not isinstance(defaults, Known):
        return merged(loader, defaults, repo)
    if defaults.key not in _configs:
        _configs[defaults.key] = pickle.dumps(merged(loader, defaults, repo))
    return pickle.loads(_configs[defaults.key])


def _stays(source: ConfigSource) -> bool:
    """Whether what it offers is the same in all tests: Hydra's own, and our conf/."""
    return source.scheme() != "file" or f"{source.scheme()}://{source.path}" == CONF

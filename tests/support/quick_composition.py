"""Hydra's compositions of our conf/, each made once a process: the tests make some thousands, mostly of the same files.

Which files are merged, and what they give, follows from the command and from the groups picked; only that is kept. The
overrides of single settings are applied by Hydra each time. Processes that start from nothing compose without this.
"""

import pickle
from pathlib import Path

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.defaults_list import DefaultsList, Overrides, create_defaults_list
from hydra.core.default_element import ResultDefault
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig

CONF = f"file://{Path(__file__).parents[2] / 'conf'}"

merged = ConfigLoaderImpl._compose_config_from_defaults_list
loaded = FileConfigSource.load_config

_files: dict[str, bytes] = {}
_lists: dict[str, DefaultsList] = {}
_configs: dict[str, bytes] = {}


class Known(list[ResultDefault]):
    """The files to merge, and which picks they follow from."""

    key: str


def install() -> None:
    """Let Hydra compose so in this process."""
    config_loader_impl.create_defaults_list = files_to_merge
    ConfigLoaderImpl._compose_config_from_defaults_list = merged_once
    FileConfigSource.load_config = loaded_once


def kept() -> bytes:
    """Return all that was composed, for another process."""
    return pickle.dumps((_files, _lists, _configs))


def keep(found: bytes) -> None:
    """Take what another process has composed."""
    for ours, theirs in zip((_files, _lists, _configs), pickle.loads(found), strict=True):
        ours.update(theirs)


def files_to_merge(repo, config_name, overrides_list, prepend_hydra, skip_missing) -> DefaultsList:
    """Return what Hydra's `create_defaults_list` does; of files of others nothing is kept."""
    arguments = dict(config_name=config_name, prepend_hydra=prepend_hydra, skip_missing=skip_missing)
    if not all(map(_stays, repo.get_sources())):
        return create_defaults_list(repo=repo, overrides_list=overrides_list, **arguments)
    picked = Overrides(repo=repo, overrides_list=overrides_list)
    places = [source.path for source in repo.get_sources()]
    key = repr((arguments, places, picked.override_choices, picked.append_group_defaults, picked.deletions))
    if key not in _lists:
        found = create_defaults_list(repo=repo, overrides_list=overrides_list, **arguments)
        found.defaults = Known(found.defaults)
        found.defaults.key = key
        _lists[key] = found
    known = _lists[key]
    return DefaultsList(known.defaults, known.defaults_tree, picked.config_overrides, known.overrides)


def merged_once(loader: ConfigLoaderImpl, defaults: list[ResultDefault], repo) -> DictConfig:
    """Return what Hydra makes of these files, a copy each time."""
    if not isinstance(defaults, Known):
        return merged(loader, defaults, repo)
    if defaults.key not in _configs:
        _configs[defaults.key] = pickle.dumps(merged(loader, defaults, repo))
    return pickle.loads(_configs[defaults.key])


def loaded_once(source: FileConfigSource, config_path: str) -> ConfigResult:
    """Return what a file holds, a copy each time."""
    if not _stays(source):
        return loaded(source, config_path)
    if config_path not in _files:
        _files[config_path] = pickle.dumps(loaded(source, config_path))
    return pickle.loads(_files[config_path])


def _stays(source: ConfigSource) -> bool:
    """Whether what it offers is the same in all tests: Hydra's own, and our conf/."""
    return source.scheme() != "file" or f"{source.scheme()}://{source.path}" == CONF

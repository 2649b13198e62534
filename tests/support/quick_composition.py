"""Hydra's compositions of our conf/, each made once a process: the tests make some thousands, mostly of the same files.

Which files are merged, and what they give, follows from the command and from the groups picked; only that is kept. The
overrides of single settings are applied by Hydra each time. Processes that start from nothing compose without this.
"""

import copy
import pickle
from pathlib import Path

from hydra._internal import config_loader_impl, defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.defaults_list import DefaultsList, Overrides, create_defaults_list
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig

ROOT = Path(__file__).parents[2]
CONF = {f"file://{folder}" for folder in (ROOT / "conf", *ROOT.glob("nerf_lightning/extensions/*/conf"))}

merged = ConfigLoaderImpl._compose_config_from_defaults_list
loaded = ConfigRepository.load_config
choices_map = getattr(defaults_list, "_create_interpolation_map", None)  # 1.4 has none, and needs none

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
    # Not of a source of files: Hydra loads their classes anew when it looks for plugins.
    ConfigRepository.load_config = loaded_once
    CachingConfigRepository.__init__ = copy_sources_only_if_changed
    if choices_map is not None:
        defaults_list._create_interpolation_map = map_if_needed


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


def loaded_once(repo: ConfigRepository, config_path: str) -> ConfigResult | None:
    """Return what a file holds, a copy each time."""
    if not all(map(_stays, repo.get_sources())):
        return loaded(repo, config_path)
    key = repr((config_path, [source.path for source in repo.get_sources()]))
    if key not in _files:
        _files[key] = pickle.dumps(loaded(repo, config_path))
    return pickle.loads(_files[key])


def copy_sources_only_if_changed(caching: CachingConfigRepository, delegate: ConfigRepository) -> None:
    """Copy what keeps the sources, which puts a new list of them in place where there are others."""
    caching.delegate, caching.cache = copy.copy(delegate), {}


def map_if_needed(overrides: Overrides, defaults: list[InputDefault], self_added: bool) -> DictConfig:
    """Return what has been chosen, as Hydra does for each file, where a choice of this file looks at it."""
    if any(each.is_interpolation() for each in defaults):
        return choices_map(overrides, defaults, self_added)
    return DictConfig({})


def _stays(source: ConfigSource) -> bool:
    """Whether what it offers is the same in all tests: Hydra's own, our conf/ and extensions'."""
    return source.scheme() != "file" or f"{source.scheme()}://{source.path}" in CONF

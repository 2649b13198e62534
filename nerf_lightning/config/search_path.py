"""Hydra's search path: conf/, then the conf/ folders of extensions."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from nerf_lightning.files.folders import conf_folders


class ExtensionsSearchPath(SearchPathPlugin):
    """The `conf/` of every extension, after our own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folders."""
        for folder in conf_folders()[1:]:
            search_path.append(provider=folder.parent.name, path=f"file://{folder}")


def search_extensions() -> None:
    """Let every config that Hydra composes from now on find the YAML files of extensions."""
    Plugins.instance().register(ExtensionsSearchPath)

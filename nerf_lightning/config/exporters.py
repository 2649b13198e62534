"""Query the exporters of our conf/what/ folders before one is built: their needs, and kernels to compile.

As a program (`python -m nerf_lightning.config.exporters`): compile all CPU kernels ahead of their first use.
"""

from typing import Any

import yaml
from hydra.utils import get_class
from omegaconf import DictConfig

from nerf_lightning.compute.compile_kernels import compile_kernels
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import SWITCH, flatten, quoted
from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.suggestions import did_you_mean
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, KERNELS

NO_EXPORTERS = ("evaluate", "video")
"""Keys of `final` that name no exporter; nor do options of conf/final/."""


def exporter_class(name: str) -> Any:
    """Return the class that `what=NAME` builds; None if it is not in our conf/, such as the user's own."""
    file = conf_file(f"what/{name}")
    return get_class(yaml.safe_load(file.read_text(encoding="utf-8"))["_target_"]) if file.is_file() else None


def exporters_after_training(final: DictConfig) -> dict[str, Any]:
    """Build the exporters that `final` names: `final.page=true`, or with settings `final.page.seconds=30`.

    Raises:
        InputError: there is no such exporter or setting, or its value makes no sense.
    """
    exporters = {}
    for name, value in final.items():
        wanted = value if isinstance(value, DictConfig) else SWITCH.get(value, value)
        if name not in (*NO_EXPORTERS, *option_names("final")) and wanted not in (False, "auto"):
            exporters[str(name)] = _exporter(str(name), wanted)
    return exporters


def build_exporter(config: DictConfig, name: str) -> Any:
    """Build the exporter of a config of `nerf export`, whose user asked for `what=NAME`.

    Raises:
        InputError: there is none of this name, or a setting makes no sense.
    """
    if "what" not in config:  # the group is optional, so Hydra lets an unknown name pass
        known = option_names("what")
        raise InputError(f"There is no what={name}.{did_you_mean(name, known, 'what=')} Known are {', '.join(known)}.")
    return build(config.what)


def _exporter(name: str, requested: Any) -> Any:
    if requested is not True and not isinstance(requested, DictConfig):
        raise InputError(f"final.{name}={requested}: give true, or settings of nerf export: final.{name}.KEY=VALUE.")
    settings = {} if requested is True else flatten(requested)
    overrides = [f"what.{key}={quoted(value)}" for key, value in settings.items()]
    try:
        with in_words("export"):
            return build_exporter(compose_config("export", [f"what={name}", *overrides]).config, name)
    except InputError as error:
        raise InputError(f"final.{name}: {error}") from error


def kernel_modules() -> list[str]:
    """Return the full names of the modules of CPU kernels: those of models and trainings, then each exporter's."""
    exporters = map(exporter_class, option_names("what"))
    of_exporters = [module for exporter in exporters for module in getattr(exporter, "kernels", ())]
    return [*(f"{KERNELS}.{module}" for module in CPU_BACKENDS), *of_exporters]


if __name__ == "__main__":
    compile_kernels(kernel_modules())

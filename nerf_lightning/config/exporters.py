"""What the exporters of our conf/what/ folders say of themselves before one is built: needs, and kernels to compile.

As a program (`python -m nerf_lightning.config.exporters`): compile all CPU kernels ahead of their first use.
"""

from typing import Any

import yaml
from hydra.utils import get_class

from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, KERNELS, backend


def exporter_class(name: str) -> Any:
    """Return the class that `what=NAME` builds; None where no conf/ of ours has it, as of a person's own."""
    file = conf_file(f"what/{name}")
    return get_class(yaml.safe_load(file.read_text(encoding="utf-8"))["_target_"]) if file.is_file() else None


def kernel_modules() -> list[str]:
    """Return the full names of the modules of CPU kernels: those of models and trainings, then each exporter's."""
    exporters = map(exporter_class, option_names("what"))
    of_exporters = [module for exporter in exporters for module in getattr(exporter, "kernels", ())]
    return [*(f"{KERNELS}.{module}" for module in CPU_BACKENDS), *of_exporters]


if __name__ == "__main__":
    for module in kernel_modules():
        backend(module)

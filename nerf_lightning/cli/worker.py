"""One of several processes that `nerf` has started: `python -m nerf_lightning.cli.worker COMMAND FOLDER LAUNCHER`.

The folder contains the config that the first process composed, and Hydra's; the command line is not repeated. LAUNCHER
is the ID of that process.
"""

import json
import sys
from pathlib import Path

from nerf_lightning.cli.main import command_module, explained
from nerf_lightning.cli.process import quick_end, quick_imports
from nerf_lightning.files.budgets import Budgets, set_limits


def main() -> None:
    """Join the other workers and run the command."""
    with quick_end(), explained(sys.argv[1]):
        _run(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))


def _run(command: str, folder: Path, launcher: int) -> None:
    with quick_imports():
        from hydra.conf import HydraConf
        from hydra.core.hydra_config import HydraConfig
        from hydra.core.utils import configure_log, setup_globals
        from omegaconf import OmegaConf

        from nerf_lightning.compute import ranks
        from nerf_lightning.compute.devices import choose_device
        from nerf_lightning.training.launch.processes import end_with, joined

        end_with(launcher)
        module = command_module(command)
    setup_globals()
    config = OmegaConf.load(folder / "config.yaml")
    set_limits(Budgets(**config.budgets))
    hydra = OmegaConf.merge(OmegaConf.structured(HydraConf), OmegaConf.load(folder / "hydra.yaml"))
    HydraConfig.instance().set_config(OmegaConf.create({"hydra": hydra}))
    configure_log(hydra.job_logging)
    with joined(choose_device(config.trainer.accelerator)[0]):
        result = module.run(config)
        if ranks.is_first():
            (folder / "result.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main()

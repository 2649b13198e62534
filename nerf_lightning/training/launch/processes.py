"""Start the processes of one run (one per device), or join those started by torchrun or srun.

Lightning would start the others by repeating the command line, which would restart sweeps. Here torch's own launcher
starts `python -m nerf_lightning.cli.worker` with the config that this process has composed.
"""

import logging
import os
import signal
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.plugins.environments import SLURMEnvironment
from omegaconf import DictConfig, OmegaConf
from torch import distributed

from nerf_lightning.compute import ranks
from nerf_lightning.compute.devices import choose_device
from nerf_lightning.compute.settings import Launcher, cluster_environment
from nerf_lightning.compute.slurm import num_tasks
from nerf_lightning.config.instantiate import require_fitting_values
from nerf_lightning.files.json_files import read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.exit_codes import OF_SIGNALS

# The parts of Hydra's own config that a worker may need.
HYDRA_PARTS = ["mode", "run", "sweep", "job", "runtime", "overrides", "job_logging"]
MOST_PROCESSES = 1024
"""Maximum number per machine; each takes half a gigabyte or more."""
LONGEST_WAIT = timedelta(hours=2)
# Time for another process to report an error before this one does.
PATIENCE_SECONDS = 3.0
WATCH_SECONDS = 1.0


def on_all_processes(command: str, config: DictConfig, work: Callable[[DictConfig], Any]) -> Any:
    """Do a command's work in as many processes as the config's trainer requests, and return the first one's result.

    Raises:
        InputError: the processes that the config requests were not started, or others were.
        SystemExit: a process ended with this code.
    """
    if distributed.is_initialized():  # a worker: its processes are already joined
        return work(config)
    require_fitting_values(config.trainer, "trainer")
    launcher: Launcher = config.trainer.launched_by
    _require_launcher(launcher)
    if launcher == "nerf":
        count = num_processes(config.trainer.devices, choose_device(config.trainer.accelerator)[0])
        return work(config) if count == 1 else launch(command, config, count)
    with joined(choose_device(config.trainer.accelerator)[0]):
        return work(config)


def num_processes(devices: int | str, device_type: str) -> int:
    """Return how many processes to start: one per device, and one for all cores of a TPU.

    Raises:
        InputError: there are fewer devices, or their number is left open on the CPU.
    """
    if device_type == "xla":
        return 1  # one process drives all cores
    there = torch.cuda.device_count() if device_type == "cuda" else 1
    if devices == "auto" and device_type == "cpu":
        raise InputError(
            "trainer.devices=auto takes every GPU, and there is none here. Say how many processes shall share the CPU "
            "(trainer.devices=2), or use trainer=cpu, whose one process has all its cores."
        )
    count = there if devices == "auto" else int(devices)
    if not 1 <= count <= MOST_PROCESSES:
        raise InputError(f"trainer.devices={devices}: give a number from 1 to {MOST_PROCESSES}, or auto for every GPU.")
    if device_type != "cpu" and count > there:
        raise InputError(f"trainer.devices={devices}: there are {there} devices here. Give at most {there}, or auto.")
    return count


def require_one_task() -> None:
    """Refuse to train in one process in a Slurm job of several tasks: Lightning would take it for one of them.

    Raises:
        InputError: says how many there are.
    """
    tasks = num_tasks()
    if tasks > 1 and not distributed.is_initialized() and SLURMEnvironment.detect():
        raise InputError(
            f"This Slurm job has {tasks} tasks (SLURM_NTASKS={tasks}), and this process would train alone, on "
            "one device. Ask for one task (sbatch or salloc --ntasks-per-node=1); or ask for --ntasks-per-node=N and "
            "start one process for each by srun nerf train trainer=slurm ..."
        )


@contextmanager
def joined(device_type: str) -> Iterator[None]:
    """Join the processes that torchrun or srun has started; only the first one prints and logs."""
    environment = cluster_environment()
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = environment.main_address, str(environment.main_port)
    if device_type == "cuda":
        torch.cuda.set_device(environment.local_rank())
    distributed.init_process_group(
        "cpu:gloo,cuda:nccl" if device_type == "cuda" else "gloo",
        rank=environment.global_rank(),
        world_size=environment.world_size(),
        timeout=LONGEST_WAIT,
    )
    if not ranks.is_first():
        logging.getLogger().setLevel(logging.ERROR)
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    try:
        yield
    except InputError:
        if not ranks.is_first():
            # Usually the first process reports the same error and ends the others; otherwise this one does after a
            # while.
            time.sleep(PATIENCE_SECONDS)
        raise
    finally:
        distributed.destroy_process_group()


def launch(command: str, config: DictConfig, count: int) -> Any:
    """Start `count` workers on this machine and wait for them; return what the first one returned.

    Raises:
        SystemExit: a worker failed or was stopped by a signal; it has reported why.
    """
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    for name in ("torch.distributed.elastic", "torch.distributed.launcher"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # it repeats the workers' errors
    with tempfile.TemporaryDirectory(prefix="nerf-") as folder, _share_of_cores(count):
        OmegaConf.save(config, Path(folder) / "config.yaml")
        hydra: Any = HydraConfig.get()
        OmegaConf.save(OmegaConf.masked_copy(hydra, HYDRA_PARTS), Path(folder) / "hydra.yaml")
        settings = LaunchConfig(
            min_nodes=1,
            max_nodes=1,
            nproc_per_node=count,
            run_id=uuid.uuid4().hex,
            rdzv_backend="c10d",
            rdzv_endpoint="127.0.0.1:0",
            local_addr="127.0.0.1",
            max_restarts=0,
            monitor_interval=0.1,
            signals_to_handle="SIGTERM,SIGINT,SIGHUP,SIGUSR1" if os.name == "posix" else "SIGTERM,SIGINT",
        )
        try:
            start_workers = elastic_launch(settings, sys.executable)
            start_workers("-m", "nerf_lightning.cli.worker", command, folder, str(os.getpid()))
        except ChildFailedError as error:
            raise SystemExit(_exit_code([failure.exitcode for failure in error.failures.values()])) from None
        except SignalException as stopped:
            raise SystemExit(OF_SIGNALS + stopped.sigval) from None
        return read_json(Path(folder) / "result.json")


def end_with(launcher: int) -> None:
    """Make a worker end soon after its launcher, which cannot stop it if killed itself."""

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(WATCH_SECONDS)
        os._exit(OF_SIGNALS + signal.SIGTERM)

    if os.name == "posix":  # elsewhere a parent's process ID says nothing
        threading.Thread(target=watch, daemon=True).start()


def _exit_code(codes: list[int]) -> int:
    # Negative: killed by a signal, mostly by the launcher after another one had failed.
    own = [code for code in codes if code > 0]
    return own[0] if own else OF_SIGNALS + signal.SIGTERM


@contextmanager
def _share_of_cores(count: int) -> Iterator[None]:
    share = str(max(1, torch.get_num_threads() // count))
    former = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = share
    try:
        yield
    finally:
        os.environ.pop("OMP_NUM_THREADS") if former is None else os.environ.update(OMP_NUM_THREADS=former)


def _require_launcher(launcher: Launcher) -> None:
    by_torchrun = distributed.is_torchelastic_launched()
    tasks, in_step = num_tasks(), "SLURM_STEP_ID" in os.environ
    by_srun = tasks > 1 and in_step
    if launcher == "torchrun" and not by_torchrun:
        raise InputError(
            "trainer=torchrun: this process was not started by torchrun. Start it with torchrun --standalone "
            "--nproc-per-node 2 -m nerf_lightning train trainer=torchrun ..., or use trainer=ddp, which starts the "
            "processes by itself."
        )
    if launcher != "nerf" and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise InputError(
            f"A sweep (-m) under trainer={launcher}: each of the processes would run the sweep by itself, and wait for "
            "the others for ever. Start nerf train -m once, with trainer=ddp for jobs of several devices, or with "
            "hydra/launcher=submitit_slurm for jobs of a cluster."
        )
    if launcher == "slurm" and ("SLURM_PROCID" not in os.environ or (tasks > 1 and not in_step)):
        raise InputError(
            "trainer=slurm: this process was not started by Slurm's srun. Put srun before nerf in the batch script, "
            "or use trainer=ddp, which starts the processes of one machine by itself."
        )
    if launcher == "slurm" and tasks > 1 and "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise InputError(
            f"trainer=slurm: this job has {tasks} tasks (SLURM_NTASKS={tasks}) and does not say how many of them each "
            "machine has. Give sbatch, salloc or srun --ntasks-per-node=N in the place of --ntasks."
        )
    if launcher == "nerf" and (by_torchrun or by_srun):
        name = "torchrun" if by_torchrun else "slurm"
        raise InputError(
            f"This process is one of several that {'torchrun' if by_torchrun else 'srun'} started, and with this "
            f"trainer each of them would train alone. Add trainer={name}, so that they train together."
        )

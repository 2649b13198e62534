"""Compile CPU kernels before they are needed, with a progress bar: half a minute, once per machine."""

import logging
from collections.abc import Sequence

from rich.progress import BarColumn, TimeElapsedColumn

from nerf_lightning.compute import ranks
from nerf_lightning.compute.cores import num_cores
from nerf_lightning.messages.console import progress_bar
from nerf_lightning.nerf.kernels.ahead import compile_ahead, to_compile

log = logging.getLogger(__name__)


def compile_kernels(modules: Sequence[str]) -> None:
    """Compile the modules of kernels that numba's cache lacks, on all cores; of several processes only the first does.

    Args:
        modules: full names, slowest first.
    """
    ranks.from_first(lambda: _compile(to_compile(modules)))


def _compile(modules: Sequence[str]) -> None:
    if not modules:
        return
    log.info("compiling kernels for this CPU, once")
    with progress_bar("{task.description}", BarColumn(), TimeElapsedColumn()) as bar:
        task, left = bar.add_task(f"compiling kernels: {len(modules)} left", total=len(modules)), len(modules)
        for _ in compile_ahead(modules, num_cores()):
            left -= 1
            bar.update(task, advance=1, description=f"compiling kernels: {left} left")

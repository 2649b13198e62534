"""Compile CPU kernels ahead of their first use, on all cores: numba itself compiles one function after another.

As a program (`python -m nerf_lightning.nerf.kernels.ahead`): compile the modules named on stdin, one per line.
"""

import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress

from nerf_lightning.nerf.kernels.backends import backend, is_kept, keeps_kernels


def to_compile(modules: Sequence[str]) -> list[str]:
    """Return which kernel modules, given by full name, are not in numba's cache."""
    return [module for module in modules if not is_kept(module)]


def compile_ahead(modules: Sequence[str], processes: int) -> Iterator[str]:
    """Compile kernel modules, and yield the name of each when it is done.

    Failures are not reported here: `backend` reports them when it loads the module.

    Args:
        modules: full names, slowest first.
        processes: number of processes that compile at a time.
    """
    if processes == 1 or not keeps_kernels():
        for module in modules:
            backend(module)
            yield module
        return
    workers: list[subprocess.Popen[str]] = []
    own = threading.local()

    def start() -> None:
        # -P: nothing is imported from the current folder.
        command = [sys.executable, "-P", "-m", __name__]
        pipe = subprocess.PIPE
        own.worker = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        workers.append(own.worker)

    def compiled(module: str) -> str:
        with suppress(OSError):  # the worker has died: this process compiles the module when it is needed
            print(module, file=own.worker.stdin, flush=True)
            own.worker.stdout.readline()
        return module

    with ThreadPoolExecutor(min(processes, len(modules)), initializer=start) as pool:
        try:
            for done in as_completed([pool.submit(compiled, module) for module in modules]):
                yield done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.kill()
                worker.communicate()


if __name__ == "__main__":
    for line in sys.stdin:
        backend(line.strip())
        print(flush=True)

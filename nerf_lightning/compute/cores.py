"""How many cores this process may keep busy."""

import os

MOST_THREADS = 4096


def num_cores() -> int:
    """Return how many cores this process may use.

    These are the cores that it may run on, but no more than Slurm gave its task (`SLURM_CPUS_PER_TASK`) and no more
    than its share among other jobs (`OMP_NUM_THREADS`, which parallel sweeps set and users may).
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # OpenMP takes a list, one number per nested level.
    shares = [os.environ.get(name, "").partition(",")[0] for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS")]
    return max(1, min([allowed, *(int(share) for share in shares if share.isdecimal())]))

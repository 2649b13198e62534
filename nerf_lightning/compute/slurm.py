"""What Slurm says about this job, and how to requeue it.

Time limits and cores of jobs: `conf/hydra/launcher/slurm.yaml`.
"""

import logging
import os
import subprocess

log = logging.getLogger(__name__)

TIMEOUT_SECONDS = 60


def slurm_job() -> str | None:
    """Return the ID of this process's Slurm job, which stays the same when the job is requeued."""
    array, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")


def num_tasks() -> int:
    """Return how many tasks Slurm has given this job or step; 1 outside Slurm."""
    tasks = os.environ.get("SLURM_NTASKS", "")
    return int(tasks) if tasks.isdecimal() else 1


def was_requeued() -> bool:
    """Return whether Slurm has started this job before."""
    return slurm_job() is not None and os.environ.get("SLURM_RESTART_COUNT", "0") not in ("", "0")


def requeue() -> None:
    """Ask Slurm to start this job again; the first of a job's processes asks for all of them."""
    job = slurm_job()
    # torchrun numbers its processes itself.
    if job is None or os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) != "0":
        return
    command = ["scontrol", "requeue", job]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT_SECONDS)
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", None) or error
        log.error(
            "%s failed: %s. Submit the job again by hand; it will resume.", " ".join(command), str(reason).strip()
        )
    else:
        log.info("Slurm job %s is queued again and will resume from here", job)

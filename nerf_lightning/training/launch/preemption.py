"""Preemption by a scheduler: stop without losing anything, and have the job started again.

During training, `callbacks/stop_signals.py` finishes the step and saves; before and after it there is nothing to save,
and the process exits at once. Either way it ends with SystemExit(OF_SIGNALS + signal), and this module does the rest:

* SIGUSR1 in a Slurm job (sbatch --signal=USR1@90): the job is requeued.
* The signal of submitit (SIGUSR2 if not configured): submitit's own handler is called, which counts and requeues.
* SIGTERM: nothing. Slurm itself requeues what it preempts, and what the user cancels must stay canceled.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from torch import distributed

from nerf_lightning.compute.slurm import requeue
from nerf_lightning.messages.exit_codes import OF_SIGNALS


@contextmanager
def preemptible() -> Iterator[None]:
    """Exit at a scheduler's signal, and requeue if the signal means that."""
    if distributed.is_initialized():  # a worker: the process that started it handles the signals
        yield
        return
    listened = [number for number in stop_signals() if number != signal.SIGINT]
    previous_handlers = {number: signal.signal(number, _leave) for number in listened}
    try:
        yield
    except SystemExit as stop:
        if wants_restart(stop.code):
            _restart(int(stop.code or 0) - OF_SIGNALS, previous_handlers)
        raise
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def wants_restart(code: Any) -> bool:
    """Return whether an exit code is of a signal after which the run is started again."""
    sent = {submitit_signal()} | ({signal.SIGUSR1} if hasattr(signal, "SIGUSR1") else set())
    return isinstance(code, int) and code - OF_SIGNALS in sent


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(OF_SIGNALS + number)


def _restart(number: int, previous_handlers: dict[int, Any]) -> None:
    handler = previous_handlers.get(number)
    if number == submitit_signal() and callable(handler):
        handler(number, None)
    elif "SUBMITIT_EXECUTOR" not in os.environ:
        requeue()


def stop_signals() -> list[int]:
    """Return the signals that make a run save and stop."""
    names = [name for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name)]
    numbers = [int(getattr(signal, name)) for name in names]
    own = submitit_signal()
    return numbers if own is None or own in numbers else [*numbers, own]


def submitit_signal() -> int | None:
    """Return the signal with which submitit ends its job when the time is up; None outside submitit."""
    if "SUBMITIT_EXECUTOR" not in os.environ:
        return None
    found = getattr(signal, "SIG" + os.environ.get("SUBMITIT_PREEMPT_SIGNAL", "USR2"), None)
    return None if found is None else int(found)

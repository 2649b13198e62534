"""Run a command and kill it, again and again. A script of its own: each run is forked after the imports.

    python tests/support/killed_runs.py PLANS ARGUMENTS...

PLANS is a json list; each start of the program takes the next: `{"after": SECONDS}`, or `{"in": FUNCTION, "call": N}`
for the N-th call of one of the functions that saving goes through, before, amid or after it, or `{"full": N}` for a
disk that is full at the N-th save. `{"phase": "MODULE:FUNCTION", "after": SECONDS}` kills so long after a function is
entered; without `after` it runs to the end, and FOLDER.seconds says how long that took. `{"largest": BYTES}` lets no
file grow beyond that. `null` lets it run to the end. Prints a json list with what became of each start.
"""

import contextlib
import errno
import importlib
import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch

from nerf_lightning.cli import main as cli
from nerf_lightning.commands import train  # noqa: F401 - what a fork need not import again

PLACES = ("before torch.save", "amid torch.save", "after torch.save", "before fsync", "before unlink", "after unlink",
          "before link", "after link", "before replace", "after replace")  # fmt: skip


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def half_saved(content, file) -> None:
    whole = io.BytesIO()
    torch_save(content, whole)
    file.write(whole.getbuffer()[: len(whole.getbuffer()) // 2])
    file.flush()
    die()


torch_save = torch.save


def arm(where: str, call: int, folder: str) -> None:
    """Kill this process at the `call`-th save that comes by this place; other files than checkpoints do not count."""
    when, _, name = where.partition(" ")
    module, name = (torch, "save") if name == "torch.save" else (os, name)
    real, calls = getattr(module, name), []

    def deadly(*arguments, **options):
        if name in ("fsync", "save") or any(str(argument).startswith(folder) for argument in arguments):
            calls.append(1)
        if len(calls) == call and when == "before":
            die()
        if len(calls) == call and when == "amid":
            half_saved(*arguments)
        result = real(*arguments, **options)
        if len(calls) == call and when == "after":
            die()
        return result

    setattr(module, name, deadly)


def fill_disk(call: int) -> None:
    """Let the disk be full at the `call`-th save."""
    real, calls = torch.save, []

    def save(content, file):
        calls.append(1)
        if len(calls) == call:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(content, file)

    torch.save = save


def at_phase(where: str, act: Callable[[], None]) -> None:
    """Do something when a function is entered."""
    module, _, name = where.partition(":")
    *path, name = name.split(".")
    owner = importlib.import_module(module)
    for part in path:
        owner = getattr(owner, part)
    real = getattr(owner, name)

    def entered(*arguments, **options):
        act()
        return real(*arguments, **options)

    setattr(owner, name, entered)


def die_after(seconds: float) -> None:
    """Let the system kill this process, whatever it is doing then; -SIGALRM is its exit code."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6))


def child(plan: dict | None, arguments: list[str], log: Path) -> None:
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    folder = next(argument.partition("=")[2] for argument in arguments if argument.startswith("paths.output_dir="))
    if plan is not None and "in" in plan:
        arm(plan["in"], plan["call"], f"{folder}/checkpoints")
    if plan is not None and "full" in plan:
        fill_disk(plan["full"])
    if plan is not None and "largest" in plan:
        import resource  # not on Windows, where its places are collected

        resource.setrlimit(resource.RLIMIT_FSIZE, (plan["largest"], plan["largest"]))
    entered: list[float] = []
    if plan is not None and "phase" in plan and "after" in plan:
        at_phase(plan["phase"], lambda: die_after(plan["after"]))
    elif plan is not None and "phase" in plan:
        at_phase(plan["phase"], lambda: entered.append(time.perf_counter()))
    elif plan is not None and "after" in plan:
        threading.Timer(plan["after"], die).start()
    sys.argv = ["nerf", *arguments]
    code = 0
    try:
        cli.main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    if entered:
        Path(f"{folder}.seconds").write_text(str(time.perf_counter() - entered[0]))
    os._exit(code)


def main() -> None:
    plans, arguments = json.loads(sys.argv[1]), sys.argv[2:]
    folder = next(argument.partition("=")[2] for argument in arguments if argument.startswith("paths.output_dir="))
    log = Path(f"{folder}.txt")
    ended = []
    for plan in plans:
        process = os.fork()
        if process == 0:
            child(plan, arguments, log)
        _, status = os.waitpid(process, 0)
        ended.append(os.waitstatus_to_exitcode(status))
    print(json.dumps(ended))


if __name__ == "__main__":
    main()

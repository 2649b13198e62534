"""Run a command and kill it, again and again. A script of its own: each run is forked after the imports.

    python tests/support/killed_runs.py PLANS ARGUMENTS...

PLANS is a json list; each start of the program takes the next: `{"after": SECONDS}`, or `{"in": FUNCTION, "call": N}`
for the N-th call of one of the functions that saving goes through, before, amid or after it, or `{"full": N}` for a
disk that is full at the N-th save. `{"in": "MODULE:FUNCTION"}` kills when a function is entered. `{"largest": BYTES}`
lets no file grow beyond that. `null` lets it run to the end. Prints a json list with what became of each start.
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


def die_in(where: str) -> None:
    """Kill this process when it enters a function."""
    module, _, name = where.partition(":")
    *path, name = name.split(".")
    owner = importlib.import_module(module)
    for part in path:
        owner = getattr(owner, part)
    setattr(owner, name, lambda *arguments, **options: die())


def child(plan: dict | None, arguments: list[str], log: Path) -> None:
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    folder = next(argument.partition("=")[2] for argument in arguments if argument.startswith("paths.output_dir="))
    plan = plan or {}
    if "call" in plan:
        arm(plan["in"], plan["call"], f"{folder}/checkpoints")
    elif "in" in plan:
        die_in(plan["in"])
    elif "full" in plan:
        fill_disk(plan["full"])
    elif "largest" in plan:
        import resource  # not on Windows, where its places are collected

        resource.setrlimit(resource.RLIMIT_FSIZE, (plan["largest"], plan["largest"]))
    elif "after" in plan:
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

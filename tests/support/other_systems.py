"""Windows and macOS, as far as they can be stood in for: to this project's modules, what they lack is missing.

Libraries see the system as it is. For Windows, files that a process has open are neither replaced nor removed.
"""

import builtins
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import psutil

REPOSITORY = Path(__file__).parents[2]
LINUX_ONLY = (
    *("sched_getaffinity", "sched_setaffinity", "pidfd_open", "memfd_create", "eventfd", "posix_fadvise", "setresuid"),
    *("posix_fallocate", "getxattr", "setxattr", "copy_file_range", "splice", "O_TMPFILE", "O_DIRECT", "O_PATH"),
)
POSIX_ONLY = (
    *("fork", "forkpty", "openpty", "register_at_fork", "wait", "wait3", "wait4", "waitid", "posix_spawn", "WNOHANG"),
    *("WIFEXITED", "WIFSIGNALED", "WEXITSTATUS", "WTERMSIG", "getuid", "geteuid", "getgid", "getegid", "getgroups"),
    *("getpgid", "getpgrp", "setpgid", "getsid", "setsid", "killpg", "nice", "getpriority", "chown", "lchown", "uname"),
    *("mkfifo", "mknod", "major", "minor", "makedev", "statvfs", "fstatvfs", "sysconf", "confstr", "getloadavg"),
    *("ctermid", "ttyname", "pread", "pwrite", "preadv", "pwritev", "sendfile", "fchdir", "fchown", "environb", "sync"),
    *("O_NONBLOCK", "O_NOFOLLOW", "O_NOCTTY", "O_DIRECTORY", "O_CLOEXEC", "O_SYNC", "EX_OK", "lockf", "readv"),
)
WINDOWS_SIGNALS = ("SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM", "SIG_DFL", "SIG_IGN")
OF_SIGNALS = ("SIG", "ITIMER", "alarm", "setitimer", "getitimer", "pause", "pthread", "sigwait", "sigpending")
# What Python runs by itself when it begins.
BEGIN = """
from pathlib import Path
from support import other_systems

other_systems.install({system!r})
if {system!r} == "win32":
    other_systems.hold_open_files(Path({below!r}))
"""
# What imports of a module find instead: attributes that are missing (None), or others.
Differences = dict[str, dict[str, Any] | None]


def _missing(*names: str) -> dict[str, Any]:
    return dict.fromkeys(names)


def _process() -> Any:
    """Return what psutil tells of a process of Windows."""
    used = psutil.Process().memory_info().rss
    return SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=used, peak_wset=used))


def differences(system: str) -> Differences:
    """Return in what modules of Python differ from Linux's on another system, by the name that `sys.platform` has."""
    if system == "darwin":
        return {
            "os": _missing(*LINUX_ONLY), "sys": {"platform": system}, "mmap": _missing("MAP_NORESERVE", "MAP_POPULATE"),
            "select": _missing("epoll"), "resource": _missing("prlimit", "RLIMIT_OFILE"),
            "signal": _missing("SIGRTMIN", "SIGRTMAX", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "sigwaitinfo", "sigtimedwait"),
        }  # fmt: skip
    import mmap
    import signal

    others = (name for name in dir(signal) if name.startswith(OF_SIGNALS) and name not in WINDOWS_SIGNALS)
    return {
        # Whatever signal it sends ends a process at once.
        "os": {"name": "nt", "O_BINARY": 0, "kill": lambda pid, _: os.kill(pid, signal.SIGKILL)}
        | _missing(*LINUX_ONLY, *POSIX_ONLY),
        "sys": {"platform": system},
        "signal": _missing(*others),
        "mmap": _missing(*(name for name in dir(mmap) if name.startswith(("MAP_", "PROT_", "MADV_")))),
        "select": _missing("poll", "epoll"),
        "socket": _missing("AF_UNIX", "send_fds", "recv_fds"),
        "time": _missing("tzset"),
        "psutil": {"Process": _process},
        **dict.fromkeys(("resource", "pty", "tty", "fcntl", "termios", "pwd", "grp", "syslog", "curses", "readline")),
    }


def _seen(real: ModuleType, others: dict[str, Any]) -> ModuleType:
    """Return a module that is another one, but for some attributes."""

    class Seen(ModuleType):
        def __getattribute__(self, name: str) -> Any:
            if name not in others:
                return getattr(real, name)
            if others[name] is None:
                raise AttributeError(f"module {real.__name__!r} has no attribute {name!r}")
            return others[name]

        def __setattr__(self, name: str, value: Any) -> None:
            setattr(real, name, value)

    return Seen(real.__name__)


def install(system: str) -> None:
    """Let the modules of this project that are imported from now on see another system."""
    seen: dict[str, ModuleType | None] = {}
    for name, others in differences(system).items():
        seen[name] = None if others is None else _seen(importlib.import_module(name), others)
    real = builtins.__import__

    def import_(name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0) -> Any:
        top, file = name.partition(".")[0], str((globals or {}).get("__file__") or "")
        if level or top not in seen or not file.startswith(str(REPOSITORY)) or "site-packages" in file:
            return real(name, globals, locals, fromlist, level)
        if seen[top] is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return seen[top] if name == top or not fromlist else real(name, globals, locals, fromlist, level)

    builtins.__import__ = import_


def hold_open_files(below: Path) -> None:
    """Let what lies in a folder be replaced, renamed and removed only while this process does not have it open."""

    def is_open(path: Any) -> bool:
        asked = os.path.realpath(path)
        descriptors = ("/proc/self/fd/" + number for number in os.listdir("/proc/self/fd"))
        return asked in [os.path.realpath(each) for each in descriptors] or asked in Path("/proc/self/maps").read_text()

    def holding(change: Callable[..., None]) -> Callable[..., None]:
        def changed(*paths: Any, **options: Any) -> None:
            for path in paths if not options.get("dir_fd") else ():
                if Path(path).is_relative_to(below) and Path(path).is_file() and is_open(path):
                    raise PermissionError(13, "The process cannot access the file because it is being used", str(path))
            change(*paths, **options)

        return changed

    for name in ("replace", "rename", "remove", "unlink"):
        setattr(os, name, holding(getattr(os, name)))


def environment(system: str, below: Path) -> dict[str, str]:
    """Return the environment in which Python, and whatever it starts, begins on another system."""
    places = (str(below / "begin"), str(REPOSITORY), str(REPOSITORY / "tests"))
    (below / "begin").mkdir(exist_ok=True)
    (below / "begin" / "sitecustomize.py").write_text(BEGIN.format(system=system, below=str(below)))
    return os.environ | {"PYTHONPATH": os.pathsep.join(places)}


if __name__ == "__main__":
    from nerf_lightning.cli.main import main

    for line in sys.stdin:
        sys.argv = ["nerf", *line.split()]
        print(line, flush=True)
        try:
            main()
        except SystemExit as stop:
            if stop.code:
                raise

"""Start processes as forks of one that has imported everything already: what `nerf` imports takes it seconds each time.

A server is started once per pytest process. It imports what `nerf` would, computes nothing, starts no threads, and
forks a child per request. The child has its own folder, environment, streams and (where asked) session. Signals, exit
codes, tracebacks and what is registered to run at the end are real; only the taking apart of all modules, which takes
another second, is left out. What is read while modules are imported would come too late for a fork: `fits_a_fork` says
where a process must start from nothing.

    python tests/support/fork_server.py DESCRIPTOR

is the server; it listens on a socket that it inherits, until the other end is closed.
"""

import atexit
import contextlib
import gc
import importlib
import io
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Mapping
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT
from typing import IO, Any, NoReturn

REPOSITORY = Path(__file__).parents[2]
# What begins so is read while torch, numba, Python itself or our own modules are loaded.
READ_AT_IMPORT = ("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_", "NUMBA_", "PYTHON", "LD_", "TORCH_", "PJRT_", "XLA_",
                  "CUDA_", "TRITON_", "SLURM_CPUS_")  # fmt: skip
# What commands import only once they need it.
LAZY = ("torch.utils.tensorboard", "torchmetrics", "matplotlib.pyplot", "imageio.v3", "imageio_ffmpeg", "PIL.Image",
        "lightning.pytorch", "hydra.main", "jinja2", "rich.console", "rich.progress", "rich._emoji_codes",
        "tensorboard.plugins.hparams.metadata", "fsspec.implementations.chained", "matplotlib.backends.backend_agg",
        "PIL.JpegImagePlugin", "PIL.PngImagePlugin", "PIL.GifImagePlugin", "PIL.PpmImagePlugin", "PIL.BmpImagePlugin",
        )  # fmt: skip
# What most forks compose: a command, and what they pick of its groups.
COMPOSED = (("train", "scene=npz", "model=nerf_tiny"), ("train", "scene=npz", "model=fast_small"), ("train",),
            ("eval",), ("render",), ("export",), ("view",), ("table",))  # fmt: skip
# One that may not be there, and one for GPUs.
NOT_IMPORTED = ("__main__", "_triton")
# The one of them that a fork can make up for.
UNBUFFERED = "PYTHONUNBUFFERED"
# `nerf` sets these before it loads torch, or triton, also where a test has called it in this very process.
SET_BY_NERF = {"GOMP_SPINCOUNT": "1000", "TRITON_DEFAULT_FP_FUSION": "1"}
LARGEST_REQUEST = 1 << 20


# Tests change the environment for a while; the server has it as it was when the tests were collected.
ENVIRONMENT = dict(os.environ)


def fits_a_fork(env: Mapping[str, str]) -> bool:
    """Whether a process with this environment may be a fork: in what is read at import it equals the server's."""
    return sys.platform == "linux" and _read_at_import(env) == _read_at_import(ENVIRONMENT)


def _read_at_import(env: Mapping[str, str]) -> dict[str, str]:
    found = {name: value for name, value in env.items() if name.startswith(READ_AT_IMPORT) and name != UNBUFFERED}
    return SET_BY_NERF | found


class Forked:
    """A fork that runs a module as `python -m` does, or code as `python -c` does; has what tests use of Popen.

    Arguments:
        what: `-m` or `-c`, the module or the code, and its arguments.
        env: the whole environment; this process's if None.
        stdin, stdout, stderr: None for this process's own, DEVNULL, PIPE (as text) or a file; for stderr also STDOUT.
    """

    def __init__(
        self,
        *what: Any,
        cwd: str | Path | None = None,
        env: Mapping[str, str] | None = None,
        start_new_session: bool = False,
        stdin: int | IO | None = DEVNULL,
        stdout: int | IO | None = PIPE,
        stderr: int | IO | None = STDOUT,
    ) -> None:
        self.args, self.returncode = [sys.executable, *map(str, what)], None
        request = {
            "arguments": self.args[1:],
            "cwd": os.fspath(cwd or os.getcwd()),
            "env": dict(os.environ if env is None else env),
            "new_session": start_new_session,
        }
        news, told = os.pipe()
        with contextlib.ExitStack() as theirs:
            theirs.callback(os.close, told)
            self.stdin, input_ = _stream(0 if stdin is None else stdin, "w", theirs)
            self.stdout, output = _stream(1 if stdout is None else stdout, "r", theirs)
            self.stderr, errors = (None, output)
            if stderr != STDOUT:
                self.stderr, errors = _stream(2 if stderr is None else stderr, "r", theirs)
            socket.send_fds(_channel(), [json.dumps(request).encode()], [told, input_, output, errors])
        self._news = open(news, "rb", buffering=0)  # noqa: SIM115 - closed with the news of the end
        self._readers: list[tuple[threading.Thread, list[str]]] = []
        self.pid = self._number()

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; return the exit code."""
        if self.returncode is None:
            if not select.select([self._news], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
            with self._news:
                self.returncode = self._number()
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str | None, str | None]:
        """Close its input, read what is left of its outputs, and wait for the end; after a timeout call it again."""
        end = None if timeout is None else time.monotonic() + timeout
        if self.stdin is not None:
            self.stdin.close()
        if not self._readers:
            self._readers = [_reading(stream) for stream in (self.stdout, self.stderr)]
        for reader, _ in self._readers:
            reader.join(None if end is None else max(0.0, end - time.monotonic()))
            if reader.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        self.wait(None if end is None else max(0.0, end - time.monotonic()))
        output, errors = (said[0] if said else None for _, said in self._readers)
        return output, errors

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> "Forked":
        return self

    def __exit__(self, *error: object) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                stream.close()
        self.wait()

    def _number(self) -> int:
        line = self._news.readline()
        if not line:
            raise RuntimeError("The server of forks has ended; what it said stands above.")
        return int(line)


def _stream(wanted: int | IO, mode: str, theirs: contextlib.ExitStack) -> tuple[IO[str] | None, int]:
    """Return our end of a pipe, if one is wanted, and the descriptor that the child gets."""
    if wanted == PIPE:
        read, write = os.pipe()
        ours, given = (read, write) if mode == "r" else (write, read)
        theirs.callback(os.close, given)
        return open(ours, mode, encoding="utf-8", errors="replace"), given
    if wanted == DEVNULL:
        nowhere = os.open(os.devnull, os.O_RDWR)
        theirs.callback(os.close, nowhere)
        return None, nowhere
    return None, wanted if isinstance(wanted, int) else wanted.fileno()


def _reading(stream: IO[str] | None) -> tuple[threading.Thread, list[str]]:
    said: list[str] = []

    def read() -> None:
        if stream is not None:
            with stream:
                said.append(stream.read())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    return reader, said


_running: tuple[subprocess.Popen, socket.socket] | None = None


def _channel() -> socket.socket:
    """Return the way to the server; it is started with the first request."""
    global _running
    if _running is None or _running[0].poll() is not None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, __file__, str(theirs.fileno())]
            server = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], cwd=REPOSITORY, env=ENVIRONMENT | {UNBUFFERED: ""}, stdin=DEVNULL
            )
        _running = server, ours
    return _running[1]


def stop() -> None:
    """End the server, if there is one."""
    global _running
    if _running is not None:
        server, channel = _running
        channel.close()
        server.wait()
        _running = None


# What follows runs in the server and its forks.


def import_everything() -> None:
    """Import what any command may need."""
    import nerf_lightning
    from nerf_lightning.cli.process import quick_imports

    ours = (module.name for module in pkgutil.walk_packages(nerf_lightning.__path__, "nerf_lightning."))
    with quick_imports():
        for name in (*LAZY, *ours):
            if not name.endswith(NOT_IMPORTED):
                with contextlib.suppress(ImportError):
                    importlib.import_module(name)
    from numba.core.registry import cpu_target

    # What numba learns before its first kernel, also where that is in its cache: half a second.
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def compose_quickly() -> None:
    """Let every fork find composed what most of them ask for; processes that start from nothing compose themselves.

    A fork composes it here: Hydra looks for its plugins then, and those to come shall look for themselves.
    """
    sys.path.append(str(Path(__file__).parent))
    import quick_composition

    sys.path.pop()
    from nerf_lightning.config.compose import compose_config

    quick_composition.install()
    reading, writing = os.pipe()
    if os.fork() == 0:
        for command, *picked in COMPOSED:
            compose_config(command, picked)
        with open(writing, "wb") as file:
            file.write(quick_composition.kept())
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as file:
        quick_composition.keep(file.read())
    os.wait()


def serve(channel: socket.socket) -> dict[str, Any] | None:
    """Fork a child per request; return in each child what was asked for, and here None when nobody can ask any more."""
    poll = select.poll()
    poll.register(channel, select.POLLIN)
    children: dict[int, tuple[int, int]] = {}
    while True:
        for descriptor, _ in poll.poll():
            if descriptor != channel.fileno():
                pid, told = children.pop(descriptor)
                poll.unregister(descriptor)
                os.close(descriptor)
                _tell(told, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
                os.close(told)
                continue
            message, given, _, _ = socket.recv_fds(channel, LARGEST_REQUEST, 4)
            if not message:
                return None
            told, *streams = given
            pid = os.fork()
            if pid == 0:
                mine = [channel.detach(), told, *streams]
                for number, stream in enumerate(streams):
                    os.dup2(stream, number)
                for other in {*mine, *children, *(told for _, told in children.values())}:
                    os.close(other)
                return json.loads(message)
            for stream in set(streams):
                os.close(stream)
            child = os.pidfd_open(pid)
            children[child] = (pid, told)
            poll.register(child, select.POLLIN)
            _tell(told, pid)


def _tell(told: int, number: int) -> None:
    with contextlib.suppress(BrokenPipeError):  # the test has ended, and does not want to know
        os.write(told, f"{number}\n".encode())


def run(request: dict[str, Any]) -> int:
    """Run what was asked for; return the exit code, negative for a signal."""
    try:
        become(request)
    except SystemExit as stop:
        if isinstance(stop.code, int | None):
            return (stop.code or 0) & 0xFF
        print(stop.code, file=sys.stderr)
        return 1
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        return -signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1
    return 0


def become(request: dict[str, Any]) -> None:
    """Make this fork what was asked for, and run it."""
    if request["new_session"]:
        os.setsid()
    # A shell's background jobs ignore Ctrl-C, and so does the server; a person's terminal does not.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    # The server's own streams led elsewhere when they were made.
    raw = bool(os.environ.get(UNBUFFERED))
    out, err = open(1, "wb", 0 if raw else -1, closefd=False), open(2, "wb", closefd=False)  # noqa: SIM115
    sys.stdout = sys.__stdout__ = io.TextIOWrapper(out, write_through=raw)
    sys.stderr = sys.__stderr__ = io.TextIOWrapper(err, errors="backslashreplace", line_buffering=True)
    sys.path[0] = os.getcwd()
    # Python's own generator is seeded anew by os.fork.
    sys.modules["numpy"].random.seed()
    sys.modules["torch"].default_generator.seed()
    kind, what, *arguments = request["arguments"]
    sys.argv = [kind, *arguments]
    if kind == "-m":
        runpy.run_module(what, run_name="__main__", alter_sys=True)
        return
    main = sys.modules["__main__"] = types.ModuleType("__main__")
    exec(compile(what, "<string>", "exec"), main.__dict__)


def end(code: int) -> NoReturn:
    """End as the interpreter does, but for taking every module apart."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError as error:
        print(f"Exception ignored in: {sys.stdout!r}\n{type(error).__name__}: {error}", file=sys.stderr)
        code = 120
    if code == -signal.SIGINT:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    os._exit(code)


def main() -> None:
    """Serve, and in each fork become what was asked for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.update(SET_BY_NERF | os.environ)
    gc.disable()
    # Not this file's folder, but where our package is.
    sys.path[0] = str(REPOSITORY)
    import_everything()
    compose_quickly()
    # What is there is there to stay: no fork need look through it, and so copy it.
    gc.collect()
    gc.freeze()
    gc.enable()
    request = serve(socket.socket(fileno=int(sys.argv[1])))
    # What was frozen cannot be taken apart in order, and some libraries would complain of that.
    os._exit(0) if request is None else end(run(request))


if __name__ == "__main__":
    main()

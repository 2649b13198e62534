"""Choose a kernel's backend: numba on the CPU, triton on CUDA, plain torch elsewhere and if those are missing."""

import functools
import hashlib
import importlib
import importlib.util
import logging
import os
import re
import shutil
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial, wraps
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

import torch

ROOM = "nerf_lightning"
KERNELS = "nerf_lightning.nerf.kernels"
CPU_BACKENDS = (
    *("render.dense", "render.gradients", "render.cpu", "mlp.cpu", "hash_grid.cpu", "carving.cpu"),
    *("histograms.cpu", "march.cpu", "ragged.cpu", "random.cpu", "lenses.cpu", "pixels.cpu", "table_adam.cpu"),
)
"""The modules that numba compiles, slowest first."""
CUDA_BACKENDS = (
    *("random.cuda", "march.cuda", "hash_grid.cuda", "spherical_harmonics.cuda", "mlp.cuda", "ragged.cuda"),
    *("field.cuda", "render.cuda", "histograms.cuda", "table_adam.cuda", "pixels.cuda", "rays.cuda"),
)
"""The modules that triton compiles."""
FP_FUSION = "TRITON_DEFAULT_FP_FUSION"
LONG_SECONDS = 2.0
DIGEST_BYTES = hashlib.sha256().digest_size
# What triton says if there is no C compiler, and if it finds no headers.
NO_COMPILER = ("C compiler", "CalledProcessError")

log = logging.getLogger(__name__)


_reasons: dict[str, str] = {}


@functools.cache
def backend(module: str) -> ModuleType | None:
    """Import and try a module of compiled kernels; None, with one warning that names the cause, if that is impossible.

    Args:
        module: its full name; it has a function `trial` that runs each of its kernels once on tiny input.
    """
    library = "triton" if module.endswith(".cuda") else "numba"
    try:
        if library == "triton":  # fused multiply-add, about which triton warns unless it was requested
            os.environ.setdefault(FP_FUSION, "1")
        found = _imported(module) if library == "triton" else _with_cache(module)
        # Compiled when first called: better here, where a fallback exists, than in the middle of a step.
        with nullcontext() if library == "numba" and _is_kept(found) else _told_if_long(library):
            try:
                _try(found)
            except Exception:  # a damaged cache, perhaps: unpickling raises anything
                if library != "numba" or not _forget_compiled(found):
                    raise
                _try(found)
        return found
    except Exception as error:  # a broken LLVM or driver raises anything: OSError, RuntimeError, SystemError
        _reasons[module] = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        _warn_once(library, _reasons[module])
        return None


def is_kept(module: str) -> bool:
    """Return whether numba's cache has kernels of a module, compiled from the present sources."""
    try:
        return _is_kept(_with_cache(module))
    except Exception:  # `backend` will report it
        return False


def _is_kept(module: ModuleType) -> bool:
    caches = [getattr(kernel._cache, "_cache_file", None) for kernel in _compiled(module)]
    try:
        return any(cache._load_index() for cache in caches if cache is not None)
    except Exception:  # a damaged index: unpickling raises anything
        return False


def keeps_kernels() -> bool:
    """Return whether other processes find in numba's cache what this one compiles."""
    return not _temporary_caches


def _with_cache(module: str) -> ModuleType:
    _configure_numba()
    found = _imported(module)
    _stamp_with_sources(found)
    return found


def _try(module: Any) -> None:
    with torch.inference_mode(False), torch.enable_grad():  # the first call may be for a picture
        module.trial()


@contextmanager
def _told_if_long(library: str) -> Iterator[None]:
    """Log what is happening if the compiler takes long: after an installation the user waits for a sign of life."""
    timer = threading.Timer(LONG_SECONDS, _tell_once, [library])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@functools.cache
def _tell_once(library: str) -> None:
    log.info("%s compiles kernels for this machine: up to a minute, the first time only", library)


def why_not(module: str) -> str:
    """Return why there is no compiled module, once `backend` has returned None."""
    return _reasons.get(module, "unknown")


def _imported(module: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's words for an unwritable cache
            raise
    _cache_elsewhere(
        "numba cannot write its cache (beside the program, in the user's cache folder, or in NUMBA_CACHE_DIR where "
        "that is set). Set NUMBA_CACHE_DIR to a folder that can be written."
    )
    return importlib.import_module(module)


def _stamp_with_sources(module: ModuleType) -> None:
    """Let numba recompile kernels if a file that they import from has changed, or a cached kernel is damaged.

    numba itself compares a cached kernel only with the kernel's own file, and loads it whatever its bytes are.
    """
    for kernel in _compiled(module):
        cache_file, digest = getattr(kernel._cache, "_cache_file", None), _digest(kernel.py_func.__module__)
        if cache_file is not None and digest not in str(cache_file._source_stamp):
            cache_file._source_stamp = f"{cache_file._source_stamp!r} {digest}"
            cache_file._save_data = partial(_save_checked, cache_file)
            cache_file._load_data = partial(_load_checked, cache_file)


def _save_checked(cache_file: Any, name: str, kernel: object) -> None:
    """Write a compiled kernel to numba's cache, followed by its checksum."""
    content = cache_file._dump(kernel)
    with cache_file._open_for_write(cache_file._data_path(name)) as file:
        file.write(content + hashlib.sha256(content).digest())


def _load_checked(cache_file: Any, name: str) -> Any:
    """Load a compiled kernel.

    Raises:
        OSError: it is damaged; numba then compiles it again.
    """
    content = Path(cache_file._data_path(name)).read_bytes()
    if hashlib.sha256(content[:-DIGEST_BYTES]).digest() != content[-DIGEST_BYTES:]:
        raise OSError("damaged")
    return type(cache_file)._load_data(cache_file, name)  # unpickling ends where the checksum begins


@functools.cache
def _digest(module: str) -> str:
    digest = hashlib.sha256()
    for file in sorted(_sources(module)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _sources(module: str) -> set[Path]:
    """Return the files of a kernel module, and of all modules of this program that it imports from."""
    found: set[Path] = set()
    waiting = [module]
    while waiting:
        spec = importlib.util.find_spec(waiting.pop())
        file = Path(str(spec and spec.origin))
        if file not in found:
            found.add(file)
            waiting += re.findall(
                rf"^from ({re.escape(ROOM)}\S*) import", file.read_text(encoding="utf-8"), re.MULTILINE
            )
    return found


def _compiled(module: ModuleType) -> list[Any]:
    from numba.core.dispatcher import Dispatcher

    return [each for each in vars(module).values() if isinstance(each, Dispatcher)]


def _forget_compiled(module: ModuleType) -> int:
    """Make numba forget a module's compiled kernels, and return how many."""
    kernels = _compiled(module)
    for kernel in kernels:
        kernel._cache.flush()
    return len(kernels)


@functools.cache
def _cache_elsewhere(reason: str) -> None:
    """Make numba cache what it compiles in a folder that lasts as long as this process."""
    import numba

    folder = tempfile.TemporaryDirectory(prefix="nerf-numba-")
    _temporary_caches.append(folder)
    numba.config.CACHE_DIR = folder.name  # type: ignore[attr-defined]
    log.warning("Until then every start compiles the kernels anew, which takes about a minute: %s", reason)


_temporary_caches: list[tempfile.TemporaryDirectory[str]] = []
"""Folders that are removed when the process ends."""


_switched_off: set[str] = set()


@contextmanager
def without(*modules: str) -> Iterator[None]:
    """Run the torch twins of some kernels within the context, for comparisons."""
    former = set(_switched_off)
    _switched_off.update(modules)
    try:
        yield
    finally:
        _switched_off.clear()
        _switched_off.update(former)


def is_on(module: str) -> bool:
    """Return whether a kernel is enabled."""
    return module not in _switched_off


def cpu_backend(module: str, device: torch.device) -> ModuleType | None:
    """Return a numba module (`march.cpu`) for tensors on the CPU; else None."""
    if device.type != "cpu" or not is_on(module):
        return None
    return backend(f"{KERNELS}.{module}")


def cuda_backend(module: str, device: torch.device) -> ModuleType | None:
    """Return a triton module for tensors on a CUDA device; else None."""
    return backend(f"{KERNELS}.{module}") if device.type == "cuda" and is_on(module) else None


def backend_for(kernel: str, device: torch.device) -> ModuleType | None:
    """Return the numba or triton module of a kernel (`march`), whichever runs on the device; else None."""
    return cpu_backend(f"{kernel}.cpu", device) or cuda_backend(f"{kernel}.cuda", device)


def can_compile(device: torch.device) -> bool:
    """Return whether torch.compile has what it needs: on the CPU, a C++ compiler."""
    return device.type == "cuda" or any(shutil.which(name) for name in ("g++", "clang++", "cl"))


def _configure_numba() -> None:
    import numba

    # Straight-line code of four equal operations becomes one operation on four lanes.
    numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]
    _require_own_cache(numba.config.CACHE_DIR)  # type: ignore[attr-defined]


def _require_own_cache(folder: str) -> None:
    """Refuse a cache folder that others can write to: numba's cache holds programs and pickles."""
    if not folder:
        return
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        about = os.stat(folder)
    except OSError:
        return  # numba notices by itself
    if hasattr(os, "geteuid") and (about.st_uid != os.geteuid() or stat.S_IMODE(about.st_mode) & 0o022):
        _cache_elsewhere(
            f"NUMBA_CACHE_DIR is {folder}, which belongs to somebody else or can be written by others "
            f"(mode {stat.S_IMODE(about.st_mode):04o}). Name a folder of your own with NUMBA_CACHE_DIR."
        )


@functools.cache
def _warn_once(library: str, reason: str) -> None:
    cure = f"Reinstall it (pip install --force-reinstall {library}), or read its list of supported machines."
    if library == "triton" and any(word in reason for word in NO_COMPILER):
        cure = (
            "It builds a small launcher with a C compiler, which needs gcc or clang and the headers of Python (Debian, "
            "Ubuntu: apt install gcc python3-dev)."
        )
    log.warning(
        "%s cannot be used here (%s): PyTorch versions of its kernels run instead, many times slower. %s",
        library,
        reason,
        cure,
    )


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def with_kernel(*modules: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Let a function return the result of a kernel for its first argument's device, and compute only if there is none.

    When changing the function, change its kernels, too, or remove this decorator until they follow: tests compare them.

    Args:
        modules: modules of `nerf.kernels`, such as `random.cpu`. Each has a function of the same name and arguments,
            which returns None for arguments that it does not support.

    >>> import torch
    >>> @with_kernel("random.cpu")
    ... def uniform(key, slots, word, count):
    ...     return "in plain torch"
    >>> one = torch.ones(1, dtype=torch.int64)
    >>> uniform(one, one, 1, 2).shape, uniform(one.view(1, 1), one.view(1, 1), 1, 2)
    (torch.Size([1, 2]), 'in plain torch')
    """

    def decorate(reference: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(reference)
        def either(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            first: Any = args[0]
            for module in modules:
                kernels = (cpu_backend if module.endswith(".cpu") else cuda_backend)(module, first.device)
                found = None if kernels is None else getattr(kernels, reference.__name__)(*args, **kwargs)
                if found is not None:
                    return found
            return reference(*args, **kwargs)

        return either

    return decorate

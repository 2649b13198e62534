"""What becomes of a kernel that cannot be compiled, or not be kept, and when a kept one is compiled again."""

import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numba
import pytest
import torch
from support.running import start_code
from support.systems import POSIX

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.table_adam.op import AdamUpdate


@pytest.fixture
def anew(monkeypatch):
    """Let every kernel be looked for again, and forget what was found."""
    former = numba.config.CACHE_DIR

    def forget():
        for cached in (backends.backend, backends._warn_once, backends._tell_once, backends._cache_elsewhere):
            cached.cache_clear()
        backends._reasons.clear()

    forget()
    yield
    monkeypatch.undo()
    forget()
    numba.config.CACHE_DIR = former


def module_whose_trial(words=None):
    def trial():
        if words:
            raise RuntimeError(words)

    module = ModuleType("a_twin")
    module.trial = trial
    return module


def test_a_kernel_that_does_not_compile_leaves_the_work_to_its_reference(anew, monkeypatch, caplog):
    monkeypatch.setattr(
        backends.importlib, "import_module", lambda name: module_whose_trial("LLVM cannot select\n this")
    )
    parameter, grad = torch.ones(3), torch.tensor([1.0, 0.0, -1.0])
    for _ in range(2):
        update = AdamUpdate([(parameter, grad.clone(), torch.zeros(3), torch.zeros(3))])
        update.set_numbers([(0.5, 1.0, 0.0, 0.0, 1e-15)])
        update()
    torch.testing.assert_close(parameter, torch.tensor([0.0, 1.0, 2.0]))
    assert backends.why_not("nerf_lightning.nerf.kernels.table_adam.cpu") == "RuntimeError: LLVM cannot select this"
    assert len(caplog.records) == 1
    assert "PyTorch versions of its kernels run instead" in caplog.text


@pytest.mark.parametrize(("takes", "said"), [(0.3, 1), (0.0, 0)])
def test_whoever_waits_for_the_compiler_is_told_once(anew, monkeypatch, caplog, takes, said):
    slow = module_whose_trial()
    slow.trial = lambda: time.sleep(takes)
    monkeypatch.setattr(backends.importlib, "import_module", lambda name: slow)
    monkeypatch.setattr(backends, "LONG_SECONDS", 0.05)
    with caplog.at_level(logging.INFO):
        backends.backend("nerf_lightning.nerf.kernels.hash_grid.cpu")
        backends.backend("nerf_lightning.nerf.kernels.march.cpu")
    assert [each.count("the first time only") for each in caplog.messages] == [1] * said


def test_a_gpu_whose_kernels_triton_cannot_compile_has_none(anew, monkeypatch, caplog):
    monkeypatch.setattr(backends.importlib, "import_module", lambda name: module_whose_trial("PTX assembly failed"))
    assert backends.cuda_backend("hash_grid.cuda", torch.device("cuda")) is None
    assert "triton cannot be used here (RuntimeError: PTX assembly failed)" in caplog.text
    assert backends.cuda_backend("hash_grid.cuda", torch.device("cpu")) is None


def test_without_a_c_compiler_or_its_headers_the_message_names_them(anew, monkeypatch, caplog):
    words = "CalledProcessError: Command '['/usr/bin/gcc', 'cuda_utils.c']' returned non-zero exit status 1"
    monkeypatch.setattr(backends.importlib, "import_module", lambda name: module_whose_trial(words))
    assert backends.cuda_backend("hash_grid.cuda", torch.device("cuda")) is None
    assert "apt install gcc python3-dev" in caplog.text
    assert "Reinstall" not in caplog.text


def test_without_a_folder_for_its_cache_numba_keeps_kernels_for_this_process(anew, monkeypatch, caplog):
    found, asked = module_whose_trial(), []

    def without_cache(name):
        asked.append(name)
        if not numba.config.CACHE_DIR:
            raise RuntimeError("cannot cache function '_forward': no locator available for file 'x.py'")
        return found

    numba.config.CACHE_DIR = ""
    monkeypatch.setattr(backends.importlib, "import_module", without_cache)
    with caplog.at_level(logging.WARNING):
        assert backends.backend("nerf_lightning.nerf.kernels.march.cpu") is found
        assert backends.backend("nerf_lightning.nerf.kernels.table_adam.cpu") is found
    assert len(asked) == 3
    assert os.access(numba.config.CACHE_DIR, os.W_OK)
    assert [record.getMessage().partition(" (")[0] for record in caplog.records] == [
        "Until then every start compiles the kernels anew, which takes about a minute: numba cannot write its cache"
    ]


KEPT = """
import logging
logging.basicConfig()
from nerf_lightning.nerf.kernels.backends import backend
print(backend("nerf_lightning.nerf.kernels.table_adam.cpu"))
"""


@pytest.mark.minutes
def test_a_damaged_cache_is_compiled_anew(tmp_path):
    def found():
        result = subprocess.run([sys.executable, "-c", KEPT], env=environment, capture_output=True, text=True)
        assert "adam/cpu.py" in result.stdout, result.stderr
        assert "cannot be used" not in result.stderr
        return {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nbc")}

    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    tmp_path.chmod(0o700)
    first = found()
    assert first
    for file in first:
        file.write_bytes(file.read_bytes()[:40])
    mended = found()
    assert found() == mended  # nothing was compiled again


KERNEL = """
from numba import njit
from room.number import NUMBER

@njit(cache=True)
def kernel():
    return NUMBER
"""
# Each number in a process of its own, that has imported nothing of the room yet.
ASKED = """
import numba, os, sys
from pathlib import Path
room, numba.config.CACHE_DIR = Path("room").absolute(), os.path.abspath("kept")
sys.path.insert(0, str(room.parent))
sys.dont_write_bytecode = True
from nerf_lightning.nerf.kernels import backends
backends.ROOM = room.name
numba.njit(lambda: 1)()  # so that each finds the compiler ready
for number in sys.argv[1:]:
    (room / "number.py").write_text(f"NUMBER = {number}\\n")
    if os.fork() == 0:
        import room.kernel as module
        backends._stamp_with_sources(module)
        print(module.kernel(), sum(module.kernel.stats.cache_hits.values()))
        break
    assert os.wait()[1] == 0
"""


def returned(tmp_path, *numbers):
    """Return for each number what the kernel returned, and how many kernels came from the cache."""
    room = tmp_path / "room"
    room.mkdir(exist_ok=True)
    (room / "__init__.py").touch()
    if not (room / "kernel.py").exists():  # numba compares its time of change
        (room / "kernel.py").write_text(KERNEL)
    process = start_code(ASKED, *numbers, cwd=tmp_path)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return output.splitlines()


@POSIX
def test_a_change_of_a_number_in_another_file_is_compiled_in(tmp_path):
    assert returned(tmp_path, 11, 11, 22) == ["11 0", "11 1", "22 0"]  # the second one is kept


@POSIX
def test_a_flipped_bit_in_a_cached_kernel_changes_no_result(tmp_path):
    number = 1234567891234
    assert returned(tmp_path, number, number) == [f"{number} 0", f"{number} 1"]
    (kept,) = tmp_path.rglob("*.nbc")
    code = kept.read_bytes()
    assert number.to_bytes(8, "little") in code
    kept.write_bytes(code.replace(number.to_bytes(8, "little"), (number + 1).to_bytes(8, "little")))
    assert returned(tmp_path, number, number) == [f"{number} 0", f"{number} 1"]


def test_the_mathematics_holds_no_conditions_for_kernels():
    """The kernels themselves, or the front of each (`op.py`), know for what there is one."""
    package = Path(backends.__file__).parents[2]
    outside = (file.relative_to(package) for file in package.rglob("*.py") if not {"kernels", "tests"} & {*file.parts})
    words = ("backend_for", "cpu_backend", "cuda_backend")
    assert [file.as_posix() for file in outside if any(word in (package / file).read_text() for word in words)] == []

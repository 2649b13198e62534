"""numba keeps a compiled kernel for as long as the kernel's own file stays the same, and looks into no other.

What a kernel takes from another file, a function or a number, is compiled into it, so a change there counts, too.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerf_lightning.nerf.kernels import backends

KERNEL = """
from numba import njit
from {room}.number import NUMBER

@njit(cache=True)
def kernel():
    return NUMBER
"""
ASKED = """
import sys
sys.path.insert(0, {folder!r})
from nerf_lightning.nerf.kernels import backends
backends.ROOM = {room!r}
import {room}.kernel as module
backends._stamp_with_sources(module)
print(module.kernel(), sum(module.kernel.stats.cache_hits.values()))
"""


def test_a_change_of_a_number_in_another_file_is_compiled_in(tmp_path):
    room = tmp_path / "room"
    room.mkdir()
    (room / "__init__.py").touch()
    (room / "kernel.py").write_text(KERNEL.format(room="room"))

    def answer(number):
        (room / "number.py").write_text(f"NUMBER = {number}\n")
        asked = [sys.executable, "-c", ASKED.format(folder=str(tmp_path), room="room")]
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(asked, env=environment, capture_output=True, text=True, check=True).stdout.split()

    assert answer(11) == ["11", "0"]
    assert answer(11) == ["11", "1"]  # kept
    assert answer(22) == ["22", "0"]


@pytest.mark.parametrize(
    ("kernel", "other"),
    [
        ("mlp.cpu", "vectors.py"),
        ("march.cpu", "grid.py"),
        ("hash_grid.cpu", "reference.py"),
        ("render.cpu", "activations.py"),
    ],
)
def test_those_that_are_known_to_take_something_are_found(kernel, other):
    assert other in {Path(file).name for file in backends._sources(f"nerf_lightning.nerf.kernels.{kernel}")}

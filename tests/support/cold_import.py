"""What `nerf train` imports, imported by a process that starts from nothing: once for all tests that ask about it."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.made_once import made_once

LOADING = """
import gc, sys, warnings
from nerf_lightning.cli.process import quick_imports
with quick_imports():
    print(gc.isenabled())
    import nerf_lightning.commands.train
print([name for name in sys.modules if name.startswith("scipy.signal")])
print(gc.isenabled(), gc.get_freeze_count() > 100_000)
print(*warnings.filters[-5:], sep="\\n")
import torchmetrics, scipy.signal
print(len(scipy.signal.convolve([1, 2], [3, 4])), sys.modules["scipy.signal"] is scipy.signal)
"""


def cold_import(factory: pytest.TempPathFactory) -> list[str]:
    """Return the lines that it printed; it has ended well, and has not complained."""

    def make(folder: Path) -> None:
        done = subprocess.run([sys.executable, "-W", "error", "-c", LOADING], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        (folder / "said.txt").write_text(done.stdout)

    return (made_once(factory, "cold_import", make) / "said.txt").read_text().splitlines()

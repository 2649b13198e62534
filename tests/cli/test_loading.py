"""What takes the longest to load is loaded without a pause, and nothing else changes."""

import gc
import subprocess
import sys

from nerf_lightning.cli.loading import quick_imports

LOADING = """
import gc, sys
from nerf_lightning.cli.loading import quick_imports
with quick_imports():
    print(gc.isenabled())
    import nerf_lightning.commands.train
print([name for name in sys.modules if name.startswith("scipy.signal")])
import torchmetrics, scipy.signal
print(len(scipy.signal.convolve([1, 2], [3, 4])), sys.modules["scipy.signal"] is scipy.signal)
print(gc.isenabled(), gc.get_freeze_count() > 100_000)
"""


def test_the_collector_rests_while_lightning_is_loaded():
    done = subprocess.run([sys.executable, "-W", "error", "-c", LOADING], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["False", "[]", "3 True", "True True"]


def test_later_jobs_of_a_sweep_leave_nothing_behind():
    import lightning  # noqa: F401

    before = gc.get_freeze_count()
    with quick_imports():
        assert gc.isenabled()
    assert gc.get_freeze_count() <= before

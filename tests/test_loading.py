"""What takes the longest to load is loaded quickly, and nothing is missing afterwards."""

import gc
import subprocess
import sys

from nerf_lightning.loading import StandIn, quick_imports


def output(code):
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_lightning_comes_without_what_its_metrics_would_plot_with():
    said = output(
        "import gc, sys\n"
        "from nerf_lightning.loading import quick_imports\n"
        "with quick_imports():\n"
        "    print(gc.isenabled())\n"
        "    import nerf_lightning.commands.training\n"
        "print([name for name in sys.modules if name.startswith(('matplotlib', 'scipy.signal', 'scipy.stats'))])\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 100_000)\n"
    )
    assert said == ["False", "[]", "True True"]


def test_what_was_left_out_is_there_when_somebody_wants_it():
    said = output(
        "from nerf_lightning.loading import quick_imports\n"
        "with quick_imports():\n"
        "    import torchmetrics\n"
        "import matplotlib; matplotlib.use('agg')\n"
        "metric = torchmetrics.MeanMetric(); metric.update(1.0)\n"
        "figure, axes = metric.plot()\n"
        "print(type(figure) is matplotlib.figure.Figure)\n"
        "from torchmetrics.utilities.plot import matplotlib as theirs\n"
        "print(theirs.axes.Axes is matplotlib.axes.Axes)\n"
    )
    assert said == ["True", "True"]


def test_another_torchmetrics_may_ask_for_more():
    said = output(
        "from nerf_lightning.loading import quick_imports\n"
        "with quick_imports():\n"
        "    import matplotlib.pyplot as plt, matplotlib.axes\n"
        "    print(plt.subplots.__name__, matplotlib.cm.__name__)\n"
        "    import lightning.pytorch\n"
        "import matplotlib.figure\n"
        "print(plt.Figure is matplotlib.figure.Figure)\n"
    )
    assert said == ["subplots matplotlib.cm", "True"]


def test_a_stand_in_is_found_by_nobody_who_looks_through_all_modules():
    stand_in = StandIn("wave", known=1)
    assert stand_in.known == 1
    assert not hasattr(stand_in, "__file__")
    assert "wave" not in sys.modules
    stand_in.forget()
    assert not hasattr(stand_in, "known")  # the module was asked, and has none
    assert "wave" in sys.modules


def test_later_jobs_of_a_sweep_leave_nothing_behind():
    import lightning  # noqa: F401

    before = gc.get_freeze_count()
    with quick_imports():
        assert gc.isenabled()
    assert gc.get_freeze_count() == before

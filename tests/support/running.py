"""Ways to run the command line in tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from support.fork_server import Forked, fits_a_fork

from nerf_lightning.config.hydra_versions import SWEEPS_REMOVE
from nerf_lightning.messages.errors import InputError

REPOSITORY = Path(__file__).parents[2]

# Drawing where the cameras stand takes longer than such a run.
NO_LAYOUT = "~callbacks.camera_layout"
# Small enough for a test: seconds in all.
FAST = (
    "model=nerf_tiny",
    "data.batch_rays=64",
    "data.crop_steps=3",
    "data.val_rays=64",
    "trainer.val_every_steps=10",
    "callbacks.validation_pictures.every_steps=10",
    "callbacks.monitor.every_steps=5",
    "callbacks.ray_histograms.every_steps=10",
    "callbacks.checkpoints.every_steps=5",
    NO_LAYOUT,
    "evaluation.max_views=2",
    "evaluation.num_pictures=1",
    "path.num_frames=2",
    "trainer.tile_points=8192",
    "trainer.max_steps=4",
)
FAST_SWEEP = FAST if SWEEPS_REMOVE else tuple(word for word in FAST if word != NO_LAYOUT)
# The hash grid with its occupancy grid, as small; its settings take the place of those above.
FAST_PATH = (
    "model=fast_small", "encoder.num_levels=3", "encoder.log2_table_size=9", "encoder.max_resolution=32",
    "field.width=16", "model.levels.fine.sampler.resolution=16", "model.levels.fine.sampler.num_steps=48",
    "data.batch_rays=256", "data.sample_budget=2000", "data.crop_steps=0",
)  # fmt: skip


def start(*arguments: str, **options) -> subprocess.Popen | Forked:
    """Start the command line as a process of its own."""
    return start_module("nerf_lightning", *arguments, **options)


def start_module(module: str, *arguments: str, **options) -> subprocess.Popen | Forked:
    """Start a module as a process of its own: a fork where that makes no difference to it."""
    env = os.environ | options.pop("env", {})
    if not fits_a_fork(env):
        return start_cold(module, *arguments, env=env, **options)
    return Forked("-m", module, *arguments, env=env, cwd=options.pop("cwd", REPOSITORY), **options)


def start_code(code: str, *arguments: str, **options) -> subprocess.Popen | Forked:
    """Run Python code in a process of its own, its standard error apart: a fork where that makes no difference."""
    env = os.environ | options.pop("env", {})
    options = {"cwd": REPOSITORY, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": env} | options
    if fits_a_fork(env):
        return Forked("-c", code, *arguments, **options)
    return subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], text=True, **options)


def start_cold(module: str, *arguments: str, **options) -> subprocess.Popen:
    """Start a module as a process of its own, which imports all that it needs."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    return subprocess.Popen(
        command,
        # A shell's background jobs ignore Ctrl-C and so would their children; a person's terminal does not.
        preexec_fn=_hear_ctrl_c if os.name == "posix" else None,
        env=os.environ | options.pop("env", {}),
        text=True,
        **({"cwd": REPOSITORY, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} | options),
    )


def _hear_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def finished(process: subprocess.Popen | Forked) -> tuple[int | None, str]:
    """Wait for the end of a process; return its exit code and what it said."""
    output, _ = process.communicate(timeout=300)
    return process.returncode, output or ""


def saved(folder: Path) -> dict:
    """Return a run's newest checkpoint; one of step 0 where there is none yet."""
    last = folder / "checkpoints" / "last.ckpt"
    return torch.load(last, weights_only=True) if last.exists() else {"global_step": 0}


def output_of(process: subprocess.Popen | Forked) -> str:
    """Wait for a process that does its work; return what it printed."""
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors or output
    return output


def done(result):
    """Expect that a command did its work; return what it left."""
    assert result.code == 0, result.err
    return result


def said(result, *parts: str) -> None:
    """Expect one paragraph with these words, exit code 2, and no traceback."""
    assert result.code == 2, result.err
    _is_one_paragraph(result.err.strip(), *parts)


def refused(call: Callable[..., object], *arguments: object, parts: tuple[str, ...]) -> str:
    """Expect one paragraph with these words of what lies below the command line, and return it.

    What a command makes of an InputError is the same for all of them, and tried with one of each kind.
    """
    with pytest.raises(InputError) as caught:
        call(*arguments)
    _is_one_paragraph(str(caught.value), *parts)
    return str(caught.value)


def _is_one_paragraph(paragraph: str, *parts: str) -> None:
    assert len(paragraph.splitlines()) == 1, paragraph
    assert "Traceback" not in paragraph
    for part in parts:
        assert part in paragraph, paragraph

"""Arguments of Lightning's Trainer that pass through (`trainer.lightning`), and those that settings of ours say.

None that passes through changes what is learnt: they say what is measured, shown or tried out. So a run of other flags
is the same run.
"""

import difflib
import inspect
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from nerf_lightning.config.instantiate import require_fitting
from nerf_lightning.messages.errors import InputError

DEFAULTS: dict[str, Any] = {"num_sanity_val_steps": 0, "enable_model_summary": False, "log_every_n_steps": 1}
"""Ours, where they differ from Lightning's."""
OWNED = {
    "accelerator": "trainer.accelerator",
    "accumulate_grad_batches": "data.batch_rays",
    "barebones": "nerf bench",
    "callbacks": "callbacks (+callbacks.NAME._target_=my_package.MyCallback)",
    "check_val_every_n_epoch": "trainer.val_every_steps",
    "default_root_dir": "paths.output_dir",
    "deterministic": "trainer.deterministic",
    "devices": "trainer.devices",
    "enable_checkpointing": "callbacks.checkpoints",
    "enable_progress_bar": "callbacks.progress_bar (~callbacks.progress_bar)",
    "gradient_clip_algorithm": "trainer.clip_norm",
    "gradient_clip_val": "trainer.clip_norm",
    "limit_predict_batches": "path.num_frames",
    "limit_test_batches": "evaluation.max_views",
    "limit_train_batches": "trainer.max_steps",
    "logger": "logger",
    "max_epochs": "trainer.max_epochs",
    "max_steps": "trainer.max_steps",
    "max_time": "budget.seconds",
    "min_epochs": "trainer.max_epochs",
    "min_steps": "trainer.max_steps",
    "model_registry": "callbacks.checkpoints",
    "num_nodes": "trainer.launched_by",
    "overfit_batches": "scene.frames, which keeps some views",
    "plugins": "trainer.launched_by",
    "precision": "trainer.precision",
    "reload_dataloaders_every_n_epochs": "data",
    "strategy": "trainer.devices",
    "sync_batchnorm": "trainer.devices (no field normalises over a batch)",
    "use_distributed_sampler": "trainer.devices",
    "val_check_interval": "trainer.val_every_steps",
}
"""What each is with us."""
REFUSALS = (MisconfigurationException, ValueError, TypeError, ImportError)
"""What Lightning raises for an argument that it does not take."""
PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}
PROFILE = "profile"


def passed_through(flags: object) -> dict[str, Any]:
    """Return the arguments that Lightning's Trainer gets beside ours.

    Args:
        flags: as given under `trainer.lightning`.

    Raises:
        InputError: one that is unknown, or ours to say, or of a value that Lightning does not take.
    """
    if not flags:
        return DEFAULTS
    if not isinstance(flags, dict):
        raise InputError(
            f"trainer.lightning={flags} does not fit: it holds arguments of Lightning's Trainer, such as "
            "trainer.lightning.profiler=simple."
        )
    known = inspect.signature(Trainer).parameters
    for name, value in flags.items():
        if name in OWNED:
            raise InputError(f"trainer.lightning.{name}={value}: the setting for this is {OWNED[name]}. Use that one.")
        if name not in known:
            raise InputError(
                f"trainer.lightning.{name}={value}: Lightning's Trainer has no such argument. {_near(name)}"
            )
        require_fitting(value, known[name].annotation, f"trainer.lightning.{name}")
    given = DEFAULTS | flags
    try:
        with _silence():
            # Tried here, since a run folder is taken before the Trainer is made.
            Trainer(
                accelerator="cpu", devices=1, plugins=[LightningEnvironment()], logger=False, max_steps=1,
                enable_checkpointing=False, enable_progress_bar=False, **given,
            )  # fmt: skip
    except REFUSALS as error:
        asked = ", ".join(f"{name}={value}" for name, value in flags.items())
        reason = " ".join(str(error).split())
        raise InputError(f"trainer.lightning ({asked}): Lightning's Trainer refuses it: {reason}") from error
    return given


def written_to(folder: Path, flags: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with a profiler that writes its table, which is wider than a terminal, to a file.

    Args:
        folder: of the run; the table is in `fit-profile.txt`.
        flags: from `passed_through`.
    """
    kind = flags.get("profiler")
    if not isinstance(kind, str) or kind not in PROFILERS:
        return flags
    return flags | {"profiler": PROFILERS[kind](dirpath=folder, filename=PROFILE)}


def _near(name: str) -> str:
    offered = sorted(set(inspect.signature(Trainer).parameters) - OWNED.keys())
    close = difflib.get_close_matches(name, [*offered, *OWNED], n=3)
    return f"Did you mean {' or '.join(close)}?" if close else f"It has {', '.join(offered)}."


@contextmanager
def _silence() -> Iterator[None]:
    former = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(former)

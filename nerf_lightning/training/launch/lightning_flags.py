"""Arguments of Lightning's Trainer that pass through (`trainer.lightning`), and those that our settings control.

None that pass through change what is learned: they control what is measured, shown or tried. So a run with other flags
is the same run.
"""

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
from nerf_lightning.config.setting_rules import LIGHTNING_ARGUMENTS
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.suggestions import did_you_mean

DEFAULTS: dict[str, Any] = {"num_sanity_val_steps": 0, "enable_model_summary": False, "log_every_n_steps": 1}
"""Our defaults, where they differ from Lightning's."""
REFUSALS = (MisconfigurationException, ValueError, TypeError, ImportError)
"""What Lightning raises for an argument that it does not accept."""
PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}
PROFILE = "profile"


def passed_through(flags: object) -> dict[str, Any]:
    """Return the arguments that Lightning's Trainer gets besides ours.

    Args:
        flags: as given under `trainer.lightning`.

    Raises:
        InputError: one is unknown, or controlled by our settings, or has a value that Lightning does not accept.
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
        if name in LIGHTNING_ARGUMENTS:
            replaced_by = LIGHTNING_ARGUMENTS[name]
            raise InputError(f"trainer.lightning.{name}={value}: the setting for this is {replaced_by}. Use that one.")
        if name not in known:
            raise InputError(
                f"trainer.lightning.{name}={value}: Lightning's Trainer has no such argument. {_near(name)}"
            )
        require_fitting(value, known[name].annotation, f"trainer.lightning.{name}")
    given = DEFAULTS | flags
    try:
        with _silence():
            # Tried here, since the run folder is created before the Trainer.
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
    """Return the arguments, with a profiler that writes its table, which is wider than a terminal, to a file.

    Args:
        folder: the run folder; the table is in `fit-profile.txt`.
        flags: the result of `passed_through`.
    """
    kind = flags.get("profiler")
    if not isinstance(kind, str) or kind not in PROFILERS:
        return flags
    return flags | {"profiler": PROFILERS[kind](dirpath=folder, filename=PROFILE)}


def _near(name: str) -> str:
    offered = sorted(set(inspect.signature(Trainer).parameters) - LIGHTNING_ARGUMENTS.keys())
    return did_you_mean(name, [*offered, *LIGHTNING_ARGUMENTS]).strip() or f"It has {', '.join(offered)}."


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

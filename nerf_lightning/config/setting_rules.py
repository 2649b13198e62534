"""Rules for settings, by group: which must agree on resume (`identity`), and which a file may set (`Trust`).

A group that is not in the table may be set only on the command line; a new reader, field, loss or callback has the row
of its group. `x.*` is each key in the section x, and `x.**` is x and everything below it. The most specific entry
applies: a setting of a trusted group that says where to write, what to fetch or how far to trust needs its own.

Combinations that do not work are refused by the parts themselves, in `fit_to` or their constructors.
"""

import hashlib
import json
import math
import os
import re
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any

WORD = re.compile(r"\w[\w-]*", re.ASCII)
LEADS_OUT = re.compile(r"^([/\\~]|[A-Za-z]:[/\\])|(^|[/\\])\.\.([/\\]|\Z)")


class Trust(Enum):
    """Which values of a setting are accepted from an untrusted file: finite numbers, switches, null, some texts."""

    PLAIN = auto()  # texts that look nothing up, and paths that stay below the folder that they are relative to
    WORDS = auto()  # single words, not paths or addresses
    NUMBERS = auto()  # no texts
    PATHS = auto()  # paths of the capture, wherever it is
    IF_THERE = auto()  # as PATHS, but only existing paths: some scenes download to them
    ONE_START = auto()  # nothing: it belongs to one start of a run, and the next one has its own
    NOTHING = auto()  # nothing: a file with it is refused, or it is ignored where that is safe

    def takes(self, value: Any) -> bool:
        """Return whether a value is accepted; a list or a section as a whole is not."""
        if self in (Trust.ONE_START, Trust.NOTHING):
            return False
        if not isinstance(value, str):
            return value is None or isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))
        if self in (Trust.WORDS, Trust.NUMBERS):
            return self is Trust.WORDS and WORD.fullmatch(value) is not None
        if self is Trust.PLAIN and LEADS_OUT.search(value):
            return False
        return "${" not in value and (self is not Trust.IF_THERE or os.path.exists(os.path.expanduser(value)))


@dataclass(frozen=True)
class Meaning:
    """The rules for a setting; the defaults apply to settings without an entry."""

    identity: bool = True
    """Runs with different values are different runs: neither resumes from the other's checkpoints."""
    outcome: bool = True
    """A run's outputs depend on it: one that finished with another value has something left to do."""
    learnt: bool = True
    """What is learned depends on it: results with different values are not repetitions of one measurement."""
    has_column: bool = True
    """It has a column in a table of runs that differ in it."""
    trust: Trust = Trust.NOTHING
    """What is accepted from a run folder, the record of a sweep, or a checkpoint."""


UNKNOWN = Meaning()

# A part of the mathematics. Nothing that nerf/ builds opens a file, and its constructors refuse unknown values.
PART = Meaning(trust=Trust.WORDS)
# Data: a reader's settings, such as the folders in a capture.
LEARNT = Meaning(trust=Trust.PLAIN)
# It identifies the results, and has its own column in a table.
OWN_COLUMN = Meaning(learnt=False, has_column=False, trust=Trust.PLAIN)
# The machine, and how it computes; a run's initial checkpoint.
MACHINE = Meaning(learnt=False, trust=Trust.PLAIN)
# The length of a run: a longer one resumes from a shorter one's checkpoints.
LENGTH = Meaning(identity=False, trust=Trust.PLAIN)
# What observes the training.
WATCHING = Meaning(identity=False, learnt=False, trust=Trust.WORDS)
# What follows the training, or does not affect it.
AFTERWARDS = replace(WATCHING, has_column=False, trust=Trust.PLAIN)
# Where to write, and how to serve and limit this start; the viewer opens a server for the current user.
ONE_START = Meaning(identity=False, outcome=False, learnt=False, has_column=False, trust=Trust.ONE_START)
# Where to write, what to fetch, and how far to trust: only the user decides.
OF_THE_USER = replace(ONE_START, trust=Trust.NOTHING)

ROWS: tuple[tuple[Meaning, str], ...] = (
    (
        PART,
        "model.** encoder.** direction_encoder.** field.** loss.** plain_loss.** correction.** refinement.** "
        "optimizer.** scheduler.** data.** callbacks.collapse_guard.**",
    ),
    (LEARNT, "scene.** trainer.clip_norm"),
    (OWN_COLUMN, "seed model scene scene.name"),
    (replace(OWN_COLUMN, trust=Trust.PATHS), "scene.root scene.video"),
    (replace(OWN_COLUMN, trust=Trust.IF_THERE), "scene.path"),  # fetched if it does not exist
    (MACHINE, "trainer.** init_from"),
    (replace(MACHINE, identity=False), "trainer.cuda_graph"),  # the same steps, launched differently
    (LENGTH, "budget.** trainer.published_steps trainer.max_steps trainer.max_epochs trainer.lightning.fast_dev_run"),
    (WATCHING, "callbacks.** trainer.val_every_steps trainer.lightning.**"),
    (replace(WATCHING, trust=Trust.PLAIN), "callbacks.checkpoints.monitor"),
    (AFTERWARDS, "scene.verify scene.metres_per_unit doctor final.** evaluation.** path.file path.views"),
    (replace(AFTERWARDS, trust=Trust.WORDS), "path.**"),
    (ONE_START, "resume resume_changed_capture print_config paths.** sweep.** viewer.** budgets.**"),
    (OF_THE_USER, "logger.** hydra.** scene.cache_dir scene.allow_outside"),
    (UNKNOWN, "scene.download.**"),
    # How a sweep is split into jobs and how many there are; what they run is not a number or a word.
    (replace(OF_THE_USER, trust=Trust.NUMBERS), "hydra.launcher.* hydra.sweeper.* hydra.sweeper.sampler.*"),
    (
        replace(OF_THE_USER, trust=Trust.WORDS),
        "hydra.launcher.batch_size hydra.launcher.name hydra.launcher.partition hydra.sweeper.direction",
    ),
)

CHOSEN_GROUPS = (
    *("callbacks", "correction", "data", "debug", "encoder", "evaluation", "experiment", "field", "loss", "model"),
    *("optimizer", "path", "refinement", "sampler", "scene", "scheduler", "trainer"),
)
"""Groups of conf/ from which a file may choose an option by name. No loggers: they send pictures to accounts."""
SWEEP_GROUPS = ("hydra/launcher", "hydra/sweeper", "hydra/sweeper/sampler")
"""Groups from which the record of a sweep may."""

PLACES = ("scene.root", "scene.path", "scene.video")
"""Paths of a capture; relative ones are resolved from where the run was started."""

TABLE = {key: meaning for meaning, keys in ROWS for key in keys.split()}


def meaning_of(key: str) -> Meaning:
    """Return the rules for a setting or a section, by its dotted key in a config.

    >>> meaning_of("optimizer.lr").identity, meaning_of("trainer.max_steps").identity
    (True, False)
    >>> meaning_of("scene.near").trust.name, meaning_of("unheard_of").trust.name
    ('PLAIN', 'NOTHING')
    """
    found = TABLE.get(row_of(key) or "", UNKNOWN)
    is_refused = names_a_class(key) and found.trust is not Trust.ONE_START
    return replace(found, trust=Trust.NOTHING) if is_refused else found


def row_of(key: str) -> str | None:
    """Return the entry of the table that applies to a key; None if there is none."""
    words = key.split(".")
    sections = (".".join([*words[:count], "**"]) for count in range(len(words), 0, -1))
    return next((name for name in (key, ".".join([*words[:-1], "*"]), *sections) if name in TABLE), None)


def names_a_class(key: str) -> bool:
    """Return whether a key is Hydra's own, such as `_target_`."""
    return any(word.startswith("_") for word in key.split("."))


def fingerprint(identity: dict[str, Any]) -> str:
    """Return a short name of an identity."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:16]


LIGHTNING_ARGUMENTS = {
    "accelerator": "trainer.accelerator",
    "accumulate_grad_batches": "data.batch_rays (where memory is short: trainer.tile_points)",
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
    "sync_batchnorm": "trainer.devices=1 (field.batch_norm trains in one process)",
    "use_distributed_sampler": "trainer.devices",
    "val_check_interval": "trainer.val_every_steps",
}
"""Arguments of Lightning's Trainer that settings of ours determine, and which ones."""

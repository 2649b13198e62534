"""What a checkpoint is, key by key: what is written and what is read are both checked against this description."""

from typing import get_args

import torch

from nerf_lightning.checkpoints.packing import packed_format
from nerf_lightning.compute.cores import MOST_THREADS
from nerf_lightning.data.captures.checks import FARTHEST, LEAST_FOCAL
from nerf_lightning.files.budgets import allowed
from nerf_lightning.files.schema import (
    Choice,
    Description,
    Many,
    Maybe,
    Named,
    Number,
    Numbers,
    Plain,
    Record,
    Text,
    Whole,
)
from nerf_lightning.nerf.geometry.frames import LARGEST_UNIT, LEAST_UNIT
from nerf_lightning.nerf.types.scene import Background, LensModel, Space

FORMAT = 4
KEY = "nerf_lightning"
PRECISIONS = ("32-true", "tf32", "bf16-mixed")
PARTS = ("model", "rays", "correction")
"""Of a training step: what their weights' names begin with."""
WEIGHTS = (torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool)
"""Types of what those hold. Numbers of other types would be cast without a word."""
LOOPS = ("fit_loop", "validate_loop", "test_loop", "predict_loop")
"""Lightning's; each is held against the trainer's own (`resume_state`)."""
VERSION = r"\d+\.\d+(\.\d+)?[\w.+-]*"


def cameras() -> Record:
    """Return what the cameras in a checkpoint may be: the fields of `Cameras`, with their shapes and ranges."""
    pixels = allowed().view_pixels
    return Record(
        {
            "c2w": Numbers(("views", 3, 4), low=-FARTHEST, high=FARTHEST),
            "focal": Numbers(("views", 2), low=LEAST_FOCAL, high=FARTHEST),
            "center": Numbers(("views", 2), low=-FARTHEST, high=FARTHEST),
            "lens": Numbers(("views", 6), low=-FARTHEST, high=FARTHEST),
            "lens_model": Choice(get_args(LensModel)),
            "width": Numbers(("views",), (torch.int64,), low=1, high=pixels),
            "height": Numbers(("views",), (torch.int64,), low=1, high=pixels),
            "ndc": Maybe(Numbers(("views", 2), low=1e-6, high=FARTHEST)),
        }
    )


def scene() -> Record:
    """Return what the scene in a checkpoint is; `require_possible_scene` asks what no single key can answer."""
    name = Text(allowed().name_characters)
    views = allowed().views
    numbers = Many(Whole(0, views), views, tuple)
    return Record(
        {
            "view_names": Many(name, views, tuple, least=1, size="views"),
            "name": name,
            "cameras": cameras(),
            "near": Numbers(("views",), low=0.0, high=FARTHEST),
            "far": Numbers(("views",), low=0.0, high=FARTHEST),
            "aabb": Numbers((2, 3), low=-FARTHEST, high=FARTHEST),
            "splits": Record(
                {"train": Many(Whole(0, views), views, tuple, least=1)},
                {"val": numbers, "test": numbers, "sources": numbers},
            ),
            "background": Choice(get_args(Background)),
            "to_user": Numbers((4, 4)),
            "space": Choice(get_args(Space)),
        },
        # Of several captures that were joined, and of units that are known; earlier versions wrote none of these.
        {
            "capture_of": Maybe(numbers),
            "captures": Many(name, views, tuple),
            "metres_per_unit": Maybe(Number(LEAST_UNIT, LARGEST_UNIT)),
        },
    )


def progress() -> Record:
    """Return what a run's place is, one key for each field of `Progress`."""
    rays = Whole(1, 1 << 31)
    counts = {key: Whole() for key in ("attempt", "step", "rays_seen", "rollbacks")}
    return Record(counts | {"batch_rays": rays, "largest_batch": rays})


def record(resumable: bool) -> Record:
    """Return what lies under this program's own key."""
    use: dict[str, Description] = {
        "format": Choice((FORMAT,)),
        "version": Text(40, VERSION),
        "config": Text(allowed().yaml_characters),
        "choices": Named(Text(200), Text(200), 200),
        "scene": scene(),
        "precision": Choice(PRECISIONS),
        "tile_points": Maybe(Whole(1, 1 << 31)),
    }
    run: dict[str, Description] = {
        "progress": progress(),
        "bad_steps": Many(Whole(), 2, least=2),
        "num_threads": Whole(1, MOST_THREADS),
        "world_size": Whole(1, 1 << 16),
    }
    # Earlier versions wrote no hashes of the pixels.
    learnt: dict[str, Description] = {"refined": cameras(), "pixels": Numbers(("views",), (torch.int64,))}
    # Nothing goes on from a file that was made smaller but its weights (`init_from`).
    smaller: dict[str, Description] = {"packed": packed_format()}
    return Record(use | run, learnt) if resumable else Record(use, run | learnt | smaller)


def checkpoint(resumable: bool) -> Record:
    """Return what a checkpoint is.

    Args:
        resumable: whether it must have what training goes on from, beside what rendering needs.
    """
    name = Text(500)
    use: dict[str, Description] = {
        "state_dict": Named(Text(500, rf"({'|'.join(PARTS)}|loss)\..+"), Numbers(dtypes=WEIGHTS), 100_000),
        "global_step": Whole(),
        KEY: record(resumable),
    }
    # What exactly an optimizer keeps, it says itself (`optimizer_state`).
    kept, group = Named(name, Plain(depth=0, tensors=True), 100), Named(name, Plain(depth=1, most=100_000), 100)
    run: dict[str, Description] = {
        "epoch": Whole(),
        "pytorch-lightning_version": Text(40, VERSION),
        "loops": Record({key: Plain(most=1000) for key in LOOPS}),
        "callbacks": Named(name, Plain(tensors=True), 100),
        "optimizer_states": Many(
            Record({"state": Named(Whole(), kept, 100_000), "param_groups": Many(group, 100, least=1)}), 1, least=1
        ),
        "lr_schedulers": Many(Plain(), 0),
    }
    # What `save_hyperparameters` of somebody's subclass adds; nothing here reads it.
    of_subclasses: dict[str, Description] = {
        "hyper_parameters": Named(name, Plain(most=100_000, tensors=True), 1000),
        "hparams_name": name,
        "hparams_type": name,
    }
    return Record(use | run, of_subclasses) if resumable else Record(use, run | of_subclasses)


def require_checkpoint(content: object, resumable: bool) -> None:
    """Hold a checkpoint against its description.

    Raises:
        Unfit: the first key that is missing, unknown, or not what it must be.
    """
    checkpoint(resumable).require(content, "", {})

"""What training goes on from, held against the run that takes it up: its weights, optimizer, callbacks and loops."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.checkpoints.format import KEY
from nerf_lightning.checkpoints.optimizer_state import Build, require_fitting_optimizer
from nerf_lightning.data.ray_batches import batch_sizes
from nerf_lightning.files.schema import Description, Plain, Unfit, like
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress

CURE = (
    "The checkpoint is damaged, or made by somebody else: go on from another one (resume=RUN_FOLDER takes the newest "
    "that is whole), or begin a new run from its weights alone (init_from=FILE)."
)


def require_resumable(
    content: Mapping[str, Any], known: Mapping[str, Tensor], build_optimizer: Build, progress: Progress, optimizer: Any
) -> None:
    """Refuse a checkpoint that is sound in itself, and not of this run.

    Args:
        content: as `read_content` returned it.
        known: the run's own weights and what else it learns, by name.
        build_optimizer: the run's.
        progress: the run's, as the loader has set it up.
        optimizer: newly made, of the run's parameters.

    Raises:
        InputError: with the place in the checkpoint.
    """
    try:
        require_fitting_weights(content["state_dict"], known)
        require_fitting_optimizer(
            content["optimizer_states"][0], optimizer, build_optimizer, most_steps=content["global_step"]
        )
        _require_progress(content[KEY], progress, content["global_step"])
    except Unfit as problem:
        raise InputError(f"Training cannot go on: {problem}. {CURE}") from problem


def require_fitting_weights(weights: Mapping[str, Tensor], known: Mapping[str, Tensor]) -> None:
    """Refuse weights of another model or of other parts beside it, and what another loss has learnt.

    Raises:
        Unfit: other names, shapes or types.
    """
    for name in [*(known.keys() - weights.keys()), *(weights.keys() - known.keys())][:1]:
        raise Unfit(f"state_dict.{name}", "is missing" if name in known else "belongs to no part of this run")
    for name, tensor in weights.items():
        if tensor.shape != known[name].shape or tensor.dtype != known[name].dtype:
            raise Unfit(
                f"state_dict.{name}",
                f"holds {tensor.dtype} in the shape {tuple(tensor.shape)}, and the run's {known[name].dtype} in "
                f"{tuple(known[name].shape)}",
            )
        if tensor.dtype == torch.bool and not tensor.dim() and not torch.equal(tensor.cpu(), known[name].cpu()):
            raise Unfit(f"state_dict.{name}", f"is {bool(tensor)}, which the run's scene and settings are not")


def require_callbacks(states: Mapping[str, Any], callbacks: list[Any]) -> None:
    """Refuse the state of callbacks that is not what they keep.

    A callback that describes its state (`STATE`) takes nothing else. Where it says so (`needs_state`), it is part of
    what the run computes, and has to be there.

    Raises:
        InputError: with the callback.
    """
    try:
        for callback in callbacks:
            key, description = callback.state_key, getattr(callback, "STATE", Plain(tensors=True))
            assert isinstance(description, Description)
            if key in states:
                description.require(states[key], f"callbacks.{key}", {})
            elif getattr(callback, "needs_state", False):
                raise Unfit(f"callbacks.{key}", "is missing")
    except Unfit as problem:
        raise InputError(f"Training cannot go on: {problem}. {CURE}") from problem


def require_loops(loops: Mapping[str, Any], ours: Mapping[str, Any], step: int, skipped: int) -> None:
    """Refuse the state of Lightning's loops that is of another kind than theirs, or of another step.

    Args:
        loops: from the checkpoint.
        ours: what the trainer's loops keep.
        step: the checkpoint's.
        skipped: batches whose step was left out.

    Raises:
        InputError: with the key.
    """
    try:
        like(ours).require(loops, "loops", {})
        fit = loops["fit_loop"]
        steps = fit["epoch_loop.manual_optimization.optim_step_progress"]["total"]
        batches = fit["epoch_loop.batch_progress"]
        if set(steps.values()) != {step}:
            raise Unfit("loops.fit_loop", f"has taken {steps['completed']} steps, and the checkpoint {step}")
        # A save within a step finds it begun, and not yet counted as done.
        most = step + skipped + 1
        counts = [*batches["total"].values(), fit["epoch_loop.state_dict"]["_batches_that_stepped"]]
        if not all(step - 1 <= count <= most for count in counts):
            raise Unfit("loops.fit_loop", f"has counted other batches than the {step} steps of the checkpoint")
        # To Lightning an epoch ends where a run does: one that was gone on with has had several.
        small = [*batches["current"].values(), *(n for part in fit["epoch_progress"].values() for n in part.values())]
        if max(small) > most:
            raise Unfit("loops.fit_loop", f"counts more than {step} steps can have had")
    except Unfit as problem:
        raise InputError(f"Training cannot go on: {problem}. {CURE}") from problem


def _require_progress(record: Mapping[str, Any], ours: Progress, step: int) -> None:
    found = Progress(**record["progress"])
    skipped, in_row = record["bad_steps"]
    step += skipped  # those count as no steps of the optimizer
    if found.largest_batch != ours.largest_batch or found.batch_rays not in batch_sizes(ours.largest_batch):
        raise Unfit("progress", f"has {found.batch_rays} rays of {found.largest_batch} in a step, not those of the run")
    if not (found.rollbacks <= found.attempt <= step + 1 and found.step <= step):
        raise Unfit("progress", f"has come to what {step} steps cannot ({asdict(found)})")
    if not found.rays_seen <= found.step * found.largest_batch:
        raise Unfit("progress.rays_seen", f"is more than {found.step} steps can see")
    if not in_row <= skipped:
        raise Unfit("bad_steps", "counts more in a row than in all")

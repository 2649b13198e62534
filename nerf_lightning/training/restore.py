"""What a checkpoint keeps of a run, what a resume restores, and what is checked first.

Lightning restores weights, optimizer, callbacks and loops; `restore_run` restores the rest.
`init_from`, which takes only the weights, is read in `runs/plan_run.py`.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.loops import _FitLoop, _PredictionLoop
from torch import Tensor, nn
from torch.optim import Optimizer

from nerf_lightning.checkpoints.format import KEY, LOOPS, require_training_state
from nerf_lightning.compute import ranks
from nerf_lightning.compute.devices import use_threads
from nerf_lightning.files.trust import Mismatch, reading, require_fit
from nerf_lightning.nerf.types.progress import Progress, batch_sizes
from nerf_lightning.training.step import TrainStep

CURE = (
    "Training cannot go on from it: take another one (resume=RUN_FOLDER takes the newest that is whole), or begin a "
    "new run from its weights alone (init_from=FILE)."
)
SIDES = (5, 7, 11, 13, 17)
"""Sides of the parameter that probes what an optimizer keeps: all different, so that each can be identified."""
RATES = ("lr", "base_lr")
"""Entries of a parameter group that the schedule sets."""
WAYS = ("fused", "foreach", "capturable")
"""Settings of how the same update is computed, which depend on the device."""
Build = Callable[[Iterable[Any]], Optimizer]


def run_state(train_step: TrainStep) -> dict[str, Any]:
    """Return what a checkpoint keeps of a run besides its record, weights and optimizer."""
    return {
        "progress": asdict(train_step.progress),
        "bad_steps": train_step.guard.state(),
        "tile_points": train_step.tiles.points,
        "num_threads": torch.get_num_threads(),
        "world_size": ranks.world_size(),
    }


def loops_after(steps: int) -> dict[str, Any]:
    """Return the state of Lightning's loops within a run's single epoch, after `steps` steps."""
    no_trainer: Any = None
    fit: Any = _FitLoop(no_trainer)
    epoch, optimizer_steps = fit.epoch_loop, fit.epoch_loop.manual_optimization.optim_step_progress
    evaluation = epoch.val_loop.state_dict()
    for epochs in (fit.epoch_progress.total, fit.epoch_progress.current):
        epochs.ready = epochs.started = 1
    for batches in (epoch.batch_progress.total, epoch.batch_progress.current):
        batches.ready = batches.started = batches.processed = batches.completed = steps
    for taken in (optimizer_steps.total, optimizer_steps.current):
        taken.ready = taken.completed = steps
    state = fit.state_dict()
    state["epoch_loop.state_dict"]["_batches_that_stepped"] = steps  # the step count of Lightning's own log
    states = state, evaluation, evaluation, _PredictionLoop(no_trainer).state_dict()
    return dict(zip(LOOPS, states, strict=True))


def restore_run(state: Mapping[str, Any], train_step: TrainStep, device: torch.device) -> None:
    """Restore a run from its `run_state`; a sum's last bits depend on the number of threads."""
    train_step.progress.take_up(Progress(**state["progress"]))
    train_step.guard.restore(state["bad_steps"], device)
    if state["world_size"] == ranks.world_size():
        use_threads(state["num_threads"])


def require_resumable(
    content: Mapping[str, Any],
    path: Path,
    weights: Mapping[str, Tensor],
    optimizer: Optimizer,
    build: Build,
    callbacks: Iterable[Any],
    loops: Mapping[str, Any],
    progress: Progress,
    multiple_of: int,
) -> None:
    """Refuse a checkpoint that is valid in itself but does not belong to this run.

    Args:
        content: the result of `read_content`.
        path: the file, for messages.
        weights: the run's weights, and all else that it learns, by name.
        optimizer: a new optimizer of the run's parameters.
        build: builds an optimizer of this kind.
        callbacks: the run's callbacks. One that annotates its state (`STATE`) accepts nothing else; the state of those
            that are part of the computation (`needs_state`) must be present.
        loops: the state of the trainer's loops.
        progress: the run's progress, as set up by the loader.
        multiple_of: number of consecutive pixels that a batch does not separate; its size is a multiple.

    Raises:
        InputError: names the place in the checkpoint.
    """
    with reading(path, CURE):
        require_training_state(content, path)
        require_fit(content["state_dict"], weights, "state_dict")
        for name, switch in weights.items():  # the kind of space, and with it the shapes of others
            if switch.dtype == torch.bool and not switch.dim() and bool(switch) != bool(content["state_dict"][name]):
                raise Mismatch(f"state_dict.{name}", f"is not {bool(switch)}, as the run's scene and settings are")
        (state,) = content["optimizer_states"]
        _require_optimizer(state, optimizer, build)
        for callback in callbacks:
            key = callback.state_key
            if key in content["callbacks"]:
                require_fit(content["callbacks"][key], getattr(callback, "STATE", object), f"callbacks.{key}")
            elif getattr(callback, "needs_state", False):
                raise Mismatch(f"callbacks.{key}", "is missing")
        require_fit(content["loops"], loops, "loops")
        steps = content["loops"]["fit_loop"]["epoch_loop.manual_optimization.optim_step_progress"]["total"]
        if set(steps.values()) != {content["global_step"]}:
            raise Mismatch("loops.fit_loop", f"has not taken the {content['global_step']} steps of the checkpoint")
        # These two determine the size of batches.
        found, largest = Progress(**content[KEY]["progress"]), progress.largest_batch
        if found.largest_batch != largest or found.batch_rays not in batch_sizes(largest, multiple_of):
            raise Mismatch("progress", f"has {found.batch_rays} rays of {found.largest_batch}, not those of the run")


def _require_optimizer(state: Any, optimizer: Optimizer, build: Build) -> None:
    ours = optimizer.state_dict()["param_groups"]
    if [_settings(group) for group in state["param_groups"]] != [_settings(group) for group in ours]:
        raise Mismatch("optimizer_states.param_groups", "is not what the run's config says")
    for group in state["param_groups"]:
        for key in group.keys() & {*RATES, *WAYS}:
            require_fit(group[key], float if key in RATES else bool | None, f"optimizer_states.{key}")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if state["state"]:  # before its first step, an optimizer keeps nothing
        template = dict(enumerate(_kept_of(parameter, build) for parameter in parameters))
        require_fit(state["state"], template, "optimizer_states")


def _settings(group: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in group.items() if key not in (*RATES, *WAYS)}


def _kept_of(parameter: Tensor, build: Build) -> dict[str, Any]:
    """Return what this kind of optimizer keeps of a parameter, on meta, by taking a step with a small one."""
    small = nn.Parameter(torch.zeros(SIDES[: parameter.dim()]))
    small.grad = torch.zeros_like(small)
    optimizer = build([small])
    optimizer.step()
    sides = dict(zip(SIDES, parameter.shape, strict=False))
    return {
        key: torch.empty([sides[side] for side in value.shape], dtype=value.dtype, device="meta")
        if isinstance(value, Tensor)
        else value
        for key, value in optimizer.state[small].items()
    }

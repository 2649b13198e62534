"""Attempts of a run, with weights drawn from seed and number; collapse guard and NaN guard decide on another.

How many there may be: `max_restarts` in conf/callbacks/default.yaml.
"""

import torch
from torch.optim import Optimizer

from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.gradients.recorded import RecordedGradients
from nerf_lightning.training.step import TrainStep


def draw_weights(train_step: TrainStep) -> None:
    """Draw the weights of this attempt, or load those that it starts from."""
    objective = train_step.objective
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(fold(train_step.seed, train_step.progress.attempt, "weights"))
        objective.reset_parameters()
    if train_step.start_weights is not None:
        objective.model.load_state_dict(train_step.start_weights)
    _forget_recordings(train_step)


def restart(train_step: TrainStep, optimizer: Optimizer) -> None:
    """Begin a new attempt with new weights, optimizer state and order of rays."""
    train_step.progress.restart()
    draw_weights(train_step)
    optimizer.state.clear()


def count_rollback(train_step: TrainStep, previous: Progress, skipped: int) -> None:
    """Begin a new attempt, with other random numbers, from the state that was just restored.

    Args:
        train_step: the run's training step.
        previous: the run's progress before.
        skipped: number of steps skipped before.
    """
    progress = train_step.progress
    progress.attempt, progress.rollbacks = previous.attempt + 1, previous.rollbacks + 1
    train_step.guard.restore([skipped, 0], train_step.device)
    _forget_recordings(train_step)


def _forget_recordings(train_step: TrainStep) -> None:
    """Free the memory of all recordings; the next step makes new ones with the new addresses."""
    if isinstance(train_step.gradients, RecordedGradients):
        train_step.gradients.recordings.clear()

"""Batch normalization (arXiv 1502.03167) with Keras's constants, an option of the article's network.

It is off by default: `batch_norm` in conf/field/nerf_mlp.yaml.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.part import Part

MOMENTUM = 0.99
EPSILON = 1e-3


class BatchNorm(Part):
    """Normalize each neuron over all samples of a step: gamma (x - mean) / sqrt(variance + epsilon) + beta.

    Outside training, mean and variance are running means over the training steps. If a step calls the layer several
    times, the last call counts.
    """

    couples_rays = True
    replays = False  # a step writes `batch_mean` and `batch_variance`, which are not counts

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_variance: Tensor
    batch_mean: Tensor
    batch_variance: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        self.register_buffer("running_mean", torch.zeros(width))
        self.register_buffer("running_variance", torch.ones(width))
        self.register_buffer("batch_mean", torch.zeros(width), persistent=False)
        self.register_buffer("batch_variance", torch.ones(width), persistent=False)

    def forward(self, rows: Float[Tensor, "points width"]) -> Float[Tensor, "points width"]:
        """Return the normalized neurons of all points."""
        if not self.training:
            running = self.running_mean, self.running_variance
            return functional.batch_norm(rows, *running, self.weight, self.bias, eps=EPSILON)
        variance, mean = torch.var_mean(rows.detach().float(), dim=0, correction=0)
        self.batch_mean.copy_(mean)
        self.batch_variance.copy_(variance)
        return functional.batch_norm(rows, None, None, self.weight, self.bias, training=True, eps=EPSILON)

    def after_step(self, rgb: Tensor, target: Tensor, weight: Tensor) -> None:
        """Update the running means with the step's."""
        # On devices whose guard does not wait, nonfinite steps get here, too.
        finite = self.batch_mean.isfinite().all() & self.batch_variance.isfinite().all()
        for running, batch in ((self.running_mean, self.batch_mean), (self.running_variance, self.batch_variance)):
            running.lerp_(torch.where(finite, batch, running), 1.0 - MOMENTUM)

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: a negative variance.
        """
        if not bool((self.running_variance >= 0.0).all()):
            raise InputError(
                f"The running variances of batch normalization in the model's state are negative. {ANOTHER}"
            )

    def reset_parameters(self) -> None:
        """Reset everything that was learned."""
        for one in (self.weight, self.running_variance):
            nn.init.ones_(one)
        for zero in (self.bias, self.running_mean):
            nn.init.zeros_(zero)

"""Several devices under Lightning: its DDP strategy, without the wrapper that sums gradients in every backward."""

from typing import Literal

from lightning.pytorch.plugins.environments import ClusterEnvironment, SLURMEnvironment, TorchElasticEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import distributed
from torch.nn import Module

Launcher = Literal["nerf", "torchrun", "slurm"]


class OneSumPerStep(DDPStrategy):
    """Leave the module unwrapped: the system adds the gradients up once a step, after its last tile.

    DDP's wrapper would do so in each tile's backward, and wants every parameter to have had a gradient there.
    """

    def _setup_model(self, model: Module) -> Module:  # type: ignore[override]
        return model

    def _register_ddp_hooks(self) -> None:
        pass


def cluster_environment() -> ClusterEnvironment:
    """Return Lightning's view of who started the processes; requeueing on Slurm is ours."""
    if distributed.is_torchelastic_launched():
        return TorchElasticEnvironment()
    return SLURMEnvironment(auto_requeue=False)

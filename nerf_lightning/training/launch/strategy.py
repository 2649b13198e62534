"""Several devices under Lightning: its DDP strategy, without the wrapper that sums gradients in every backward."""

from lightning.pytorch.strategies import DDPStrategy
from torch.nn import Module


class OneSumPerStep(DDPStrategy):
    """Leave the module unwrapped: the system adds the gradients up once a step, after its last tile.

    DDP's wrapper would do so in each tile's backward, and wants every parameter to have had a gradient there.
    """

    def _setup_model(self, model: Module) -> Module:  # type: ignore[override]
        return model

    def _register_ddp_hooks(self) -> None:
        pass

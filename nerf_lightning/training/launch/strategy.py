"""Several devices under Lightning: its DDP strategy, without the wrapper that sums gradients in every backward."""

from lightning.pytorch.strategies import DDPStrategy
from torch.nn import Module


class OneSumPerStep(DDPStrategy):
    """Leave the module unwrapped: the system sums the gradients once per step, after the last tile.

    DDP's wrapper would do so in each tile's backward pass, and requires every parameter to get a gradient there.
    """

    def _setup_model(self, model: Module) -> Module:  # type: ignore[override]
        return model

    def _register_ddp_hooks(self) -> None:
        pass

"""Whether a scene's space is contracted, as a part of a model: set when it is placed, carried by its checkpoint."""

from typing import Any

import torch
from torch import Tensor, nn

from nerf_lightning.types.scene import Scene


class Contracted(nn.Module):
    """A switch that the scene sets, unless the config has.

    Args:
        fixed: what the config says; None leaves it to the scene.
    """

    switch: Tensor

    def __init__(self, fixed: bool | None = None):
        super().__init__()
        self.fixed = fixed
        self.register_buffer("switch", torch.tensor(bool(fixed)))
        # Reading the buffer stops a GPU, so it is read once.
        self._known: bool | None = bool(fixed)

    def place(self, scene: Scene) -> None:
        """Do as the scene says."""
        if self.fixed is None:
            self.switch.fill_(scene.space == "contracted")
        self.forget()

    def forget(self) -> None:
        """Look the buffer up again, since it was written to."""
        self._known = None

    def is_on(self) -> bool:
        """Tell whether space is contracted."""
        if self._known is None:
            self._known = bool(self.switch)
        return self._known

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.forget()

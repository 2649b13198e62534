"""LPIPS (arXiv 1801.03924, version 0.1) as torchmetrics computes it, on a backbone of torchvision (the extra lpips).

It is off by default: `lpips` in conf/evaluation/default.yaml.
"""

from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

from nerf_lightning.messages.errors import InputError, require_extra
from nerf_lightning.nerf.matmul_precision import disable_autocast

LPIPS_HINT = "evaluation.lpips=alex computes it (vgg: what many NeRF papers report); it needs pip install '.[lpips]'"

Net = Literal["alex", "vgg"]

_BACKBONES: dict[Net, str] = {"alex": "alexnet", "vgg": "vgg16"}
_SMALLEST: dict[Net, int] = {"alex": 31, "vgg": 16}
"""Smallest side in pixels of which pooling leaves anything."""


class LPIPS:
    """Perceptual distance of two pictures: weighted squared differences of unit-length deep features.

    Args:
        net: the backbone. "alex" is the usual choice for reporting, "vgg" the one many NeRF papers report.

    Raises:
        InputError: torchvision is missing, or its weights are neither in torch's cache nor available for download.
    """

    def __init__(self, net: Net) -> None:
        self.net = net
        models = require_extra("torchvision.models", "lpips", f"evaluation.lpips={net}")
        try:
            self._metric = LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=True)
        except (OSError, RuntimeError) as error:  # no network; a file that differs from the published one
            source = models.get_model_weights(_BACKBONES[net]).DEFAULT.url
            raise InputError(
                f"evaluation.lpips={net}: the weights of its network could not be loaded ({error}). Without a network, "
                f"download {source} elsewhere and copy it into {Path(torch.hub.get_dir()) / 'checkpoints'}, or leave "
                "evaluation.lpips out."
            ) from error

    @disable_autocast
    def score(self, render: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]) -> float | None:
        """Return the distance of two pictures with colors in [0, 1]: 0 for equal ones, rarely above 1.

        None for pictures too small for the backbone (31 pixels for alex, 16 for vgg).
        """
        if min(render.shape[:2]) < _SMALLEST[self.net]:
            return None
        pictures = torch.stack([render, truth]).movedim(-1, 1).clamp(0, 1)
        return float(self._metric(pictures[:1], pictures[1:]))

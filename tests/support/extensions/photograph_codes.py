"""The MLP of the original NeRF, whose color knows a code of each photograph (Sec. 4.1, arXiv 2008.02268)."""

import torch
from torch import nn

from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP


class NerfMLPWithCodes(NerfMLP):
    def __init__(self, position_encoder: Encoder, direction_encoder: Encoder, depth: int = 8, width: int = 256,
                 skip: int | None = 5, density_activation: str = "relu"):  # fmt: skip
        super().__init__(position_encoder, direction_encoder, depth, width, skip, density_activation)
        self.codes = nn.Parameter(torch.zeros(1, width))

    def fit_to(self, scene):
        super().fit_to(scene)
        self.codes.data = self.codes.new_zeros(len(scene.near), self.codes.shape[1])

    def color_feature(self, hidden, points):
        feature = super().color_feature(hidden, points)
        return feature if points.photograph is None else feature + self.codes[points.photograph].to(feature.dtype)

    def reset_parameters(self):
        super().reset_parameters()
        if hasattr(self, "codes"):
            nn.init.zeros_(self.codes)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        codes = state_dict.get(f"{prefix}codes", self.codes)
        self.codes.data = self.codes.new_zeros(codes.shape)
        super()._load_from_state_dict(state_dict, prefix, *args)

"""Features of photographs: a small convolutional network with skips between its scales."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.models.view_transformer.image_norm import ImageNorm, normalized
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.products import own_precision


class ImageNetwork(Part):
    """Residual blocks at 1/2, 1/4, ... of the picture's size and one scale beyond that of the features, and back.

    The papers' is the first half of a ResNet34 with instance norm (arXiv 2102.13090). Here each scale has as many
    blocks as the others, and halves the size by a 4 x 4 convolution that is centred between pixels, so that the
    feature of row i stands at (i + 1/2) `scale` pixels.

    Args:
        features: channels that come out.
        scale: pixels of the picture per feature, along each side: 2, 4 or 8.
        width: channels at half the size; twice as many at each smaller one.
        blocks: residual blocks at each size.
        norm: what is done to the pictures first.
    """

    def __init__(self, features: int, scale: int, width: int, blocks: int, norm: ImageNorm):
        super().__init__()
        self.scale, self.norm = scale, norm
        widths = [width << level for level in range(scale.bit_length())]
        self.down = nn.ModuleList(
            nn.Sequential(_halve(before, after), *[_Residual(after) for _ in range(blocks)])
            for before, after in zip([3, *widths[:-1]], widths, strict=True)
        )
        self.join = nn.Sequential(_convolve(widths[-1] + widths[-2], widths[-2]), nn.ReLU(inplace=True))
        self.out = nn.Conv2d(widths[-2], features, 1)

    @own_precision
    def forward(self, pictures: Float[Tensor, "views 3 height width"]) -> Float[Tensor, "views features rows columns"]:
        """Return the features of pictures of one size, rows and columns a `scale`th of it, rounded up."""
        height, width = pictures.shape[-2:]
        unit = 2 * self.scale
        # Of a single feature at the smallest scale no deviation could be taken.
        bottom, right = -height % unit, max(2 * unit, width + -width % unit) - width
        found = functional.pad(normalized(pictures, self.norm), (0, right, 0, bottom), mode="replicate")
        levels: list[Tensor] = []
        for level in self.down:
            found = level(found)
            levels.append(found)
        wide = functional.interpolate(levels[-1], scale_factor=2, mode="nearest")
        features = self.out(self.join(torch.cat([wide, levels[-2]], dim=1)))
        return features[:, :, : -(-height // self.scale), : -(-width // self.scale)]


class _Residual(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.first, self.second = _convolve(width, width), _convolve(width, width)

    def forward(self, features: Tensor) -> Tensor:
        return functional.relu(features + self.second(functional.relu(self.first(features), inplace=True)))


def _convolve(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.InstanceNorm2d(outputs, affine=True),
    )


def _halve(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False),
        nn.InstanceNorm2d(outputs, affine=True),
        nn.ReLU(inplace=True),
    )

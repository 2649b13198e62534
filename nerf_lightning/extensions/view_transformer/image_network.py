"""Features of photographs: a small convolutional network with skip connections between its scales."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.part import Part

ImageNorm = Literal["none", "instance", "neurn"]
PATCH = 3
"""Side in pixels of the squares whose standard deviation is computed."""
LEAST_DEVIATION = 1e-6
"""Smaller deviations of colors in [0, 1] are rounding, and count as 0."""


def normalized(
    pictures: Float[Tensor, "views 3 height width"], kind: ImageNorm
) -> Float[Tensor, "views 3 height width"]:
    """Return normalized pictures for the image network.

    Args:
        pictures: colors in [0, 1].
        kind: `none` maps them to [-1, 1]; `instance` gives each channel of each picture mean 0 and deviation 1;
            `neurn` is `local_deviation`.
    """
    if kind == "neurn":
        return local_deviation(pictures)
    if kind == "instance":
        return functional.instance_norm(pictures)
    return 2.0 * pictures - 1.0


def local_deviation(
    pictures: Float[Tensor, "*views channels height width"], patch: int = PATCH
) -> Float[Tensor, "*views channels height width"]:
    """Return the standard deviation around each pixel over the picture's largest, channel by channel, in [0, 1].

    NeuRN (arXiv 2505.06894), inspired by neurons that respond to contrast. It is invariant to gain and offset of a
    channel, and 0 where the color is constant. Borders are padded by replication.
    """
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    around = functional.pad(flat, (patch // 2,) * 4, mode="replicate").unfold(-2, patch, 1).unfold(-2, patch, 1)
    # Not as a difference of means of squares, which loses all digits at low contrast.
    apart = around - around.mean(dim=(-2, -1), keepdim=True)
    deviation = apart.square().mean(dim=(-2, -1)).sqrt()
    deviation = torch.where(deviation > LEAST_DEVIATION, deviation, 0.0)
    largest = deviation.amax(dim=(-2, -1), keepdim=True)
    return (deviation / largest.clamp(min=LEAST_DEVIATION)).view_as(pictures)


class ImageNetwork(Part):
    """Residual blocks at 1/2, 1/4, ... of the picture's size and one scale beyond that of the features, and back.

    The papers use the first half of a ResNet34 with instance norm (arXiv 2102.13090). Here all scales have equally many
    blocks, and halve the size by a 4 x 4 convolution that is centered between pixels, so that the feature of row i is
    at (i + 1/2) `scale` pixels.

    Args:
        features: number of output channels.
        scale: pixels of the picture per feature, along each side: 2, 4 or 8.
        width: channels at half the size; doubled at each smaller one.
        blocks: residual blocks at each size.
        norm: normalization of the pictures.
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

    @disable_autocast
    def forward(self, pictures: Float[Tensor, "views 3 height width"]) -> Float[Tensor, "views features rows columns"]:
        """Return the features of pictures of one size; rows and columns are that size over `scale`, rounded up."""
        height, width = pictures.shape[-2:]
        unit = 2 * self.scale
        # A single feature at the smallest scale has no deviation.
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

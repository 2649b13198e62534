"""LPIPS (arXiv 1801.03924, version 0.1) in plain torch, on a backbone whose weights the user brings.

The usual packages need torchvision and a download at run time; this needs neither. Our layers carry the names
of torchvision's state dict; the learned weights of the channels lie in torchmetrics' package.
"""

from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.files.regular import what_is
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.files.trust import reading, require_fit
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import disable_autocast

LPIPS_HINT = (
    "it needs the weights of a backbone: on a machine with torchvision, run "
    "`torch.save(torchvision.models.alexnet(weights='DEFAULT').state_dict(), 'alexnet.pth')`, copy the file here and "
    "set evaluation.lpips_weights=alexnet.pth (for the net vgg, vgg16 instead of alexnet)"
)

Net = Literal["alex", "vgg"]

_TAPS: dict[Net, tuple[int, ...]] = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""The rectified layers whose features are compared."""
_SMALLEST: dict[Net, int] = {"alex": 31, "vgg": 16}
"""Pixels below which pooling leaves nothing of a side."""
_ALEX = ((64, 11, 4, 2), (192, 5, 1, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1))
"""Channels, kernel, stride and padding; the second and the third come after pooling."""
_VGG_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
_TINY = 1e-8
"""Keeps the length of a feature of zeros from dividing by zero; the reference's value."""


class LPIPS(nn.Module):
    """Perceptual distance of two pictures: weighted squared differences of unit-length deep features.

    Args:
        net: which backbone. "alex" is the usual choice for reporting, "vgg" the one many NeRF papers report.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: Net = "alex") -> None:
        super().__init__()
        self.net = net
        self.features = nn.Sequential(*(_alexnet() if net == "alex" else _vgg16()))
        # The reference's constants: ImageNet's mean and deviation for pictures in [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None], persistent=False)
        for level, weight in enumerate(_channel_weights(net)):
            self.register_buffer(f"channels{level}", weight, persistent=False)
        self.requires_grad_(False)

    @disable_autocast
    def forward(
        self, render: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, ""]:
        """Return the distance of two pictures with colors in [0, 1]: 0 for equal ones, seldom above 1."""
        features = torch.stack([render, truth]).movedim(-1, 1).clamp(0, 1) * 2 - 1
        features = (features - self.shift) / self.scale
        distance, level = features.new_zeros(()), 0
        for index, layer in enumerate(self.features):
            features = layer(features)
            if index in _TAPS[self.net]:
                unit = features / (features.square().sum(dim=1, keepdim=True) + _TINY).sqrt()
                weights = self.get_buffer(f"channels{level}")
                distance = distance + ((unit[0] - unit[1]).square() * weights).sum(dim=0).mean()
                level += 1
        return distance

    def score(self, render: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]) -> float | None:
        """Return the distance as a number; None for pictures too small for the backbone (31 or 16)."""
        return None if min(render.shape[:2]) < _SMALLEST[self.net] else float(self(render, truth))


def load_lpips(weights: str | None, net: Net = "alex") -> LPIPS | None:
    """Return LPIPS on the backbone in the file `weights`, a state dict as torchvision's; None for None.

    Only the convolutions (`features.*`) are read. The file is read as data: nothing in it is run.
    """
    if weights is None:
        return None
    path, cure = Path(weights), f"To have LPIPS, {LPIPS_HINT}"
    if not path.is_file():
        raise InputError(f"evaluation.lpips_weights={weights}: {path} {what_is(path)}. {cure}")
    model = LPIPS(net)
    template = model.state_dict()
    with reading(path, cure):
        state = load_tensors(path)
        require_fit(state, dict[str, object], "weights")
        state = {name: tensor for name, tensor in state.items() if name.startswith("features.")}
        require_fit(state, template, "weights")
    model.load_state_dict(state)
    return model.eval()


def _channel_weights(net: Net) -> list[Float[Tensor, "channels 1 1"]]:
    """Return the learned weight of each channel of each compared layer."""
    source = files("torchmetrics") / "functional" / "image" / "lpips_models" / f"{net}.pth"
    with as_file(source) as path:
        state = torch.load(path, map_location="cpu", weights_only=True)  # of torchmetrics, in PyTorch's earlier format
    return [state[f"lin{level}.model.1.weight"][0] for level in range(len(_TAPS[net]))]


def _alexnet() -> list[nn.Module]:
    layers: list[nn.Module] = []
    width = 3
    for wider, kernel, stride, padding in _ALEX:
        if 0 < len(layers) < 6:
            layers.append(nn.MaxPool2d(kernel_size=3, stride=2))
        layers += [nn.Conv2d(width, wider, kernel, stride, padding), nn.ReLU()]
        width = wider
    return layers


def _vgg16() -> list[nn.Module]:
    layers: list[nn.Module] = []
    width = 3
    for block in _VGG_WIDTHS:
        if layers:
            layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
        for wider in block:
            layers += [nn.Conv2d(width, wider, kernel_size=3, padding=1), nn.ReLU()]
            width = wider
    return layers

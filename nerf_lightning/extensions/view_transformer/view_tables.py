"""Tables of photographs' colors and features, with interpolated look-up."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from nerf_lightning.extensions.view_transformer.image_network import ImageNetwork
from nerf_lightning.extensions.view_transformer.projection import seen_cosines
from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.types.photographs import Photographs

CACHE_BYTES = 1 << 28
"""Bytes of colors, and of features, that are cached for the next rays."""
AT_ONCE = 16
"""Number of pictures that go through the image network together."""


@dataclass(frozen=True)
class ViewTable:
    """Values at each pixel of some views, which may differ in size."""

    rows: Float[Tensor, "rows channels"]
    first: Int[Tensor, "views"]
    """Each view's first row."""
    size: Int[Tensor, "views 2"]
    """Columns and rows of each view."""
    scale: int
    """Pixels of the photograph per row, along each side."""

    def look_up(
        self, view: Int[Tensor, "*#points"], xy: Float[Tensor, "*points 2"]
    ) -> Float[Tensor, "*points channels"]:
        """Return bilinearly interpolated values at places in views; borders are replicated.

        Args:
            view: its index in this table.
            xy: pixels of the photograph, from its upper left corner (x, y).
        """
        size = self.size[view]
        last = (size - 1).expand(xy.shape)
        place = (xy / self.scale - 0.5).clamp(min=0.0).minimum(last.to(xy))
        low = place.detach().long()
        high = torch.minimum(low + 1, last)
        right, down = (place - low).unbind(dim=-1)
        (x, y), (x_next, y_next) = low.unbind(dim=-1), high.unbind(dim=-1)
        top, under = self.first[view] + y * size[..., 0], self.first[view] + y_next * size[..., 0]
        rows = torch.stack([top + x, top + x_next, under + x, under + x_next], dim=-1)
        left, up = 1.0 - right, 1.0 - down
        shares = torch.stack([up * left, up * right, down * left, down * right], dim=-1)
        found = embedding_bag(rows.view(-1, 4), self.rows, mode="sum", per_sample_weights=shares.view(-1, 4))
        return found.view(*xy.shape[:-1], -1)


class ViewTables:
    """The tables of photographs, made view by view, and cached while they are valid.

    Args:
        photographs: their source.
    """

    def __init__(self, photographs: Photographs):
        self.photographs = photographs
        self.least_cosine = seen_cosines(photographs.cameras)
        self.size = torch.stack([photographs.pixels.width, photographs.pixels.height], dim=-1)
        self._colors, self._features = _Cache(), _Cache()

    def move_to(self, device: torch.device) -> None:
        """Move everything except the pixels to a device: the host would wait for a copy in each step."""
        self.photographs = self.photographs.to(device)
        self.least_cosine, self.size = self.least_cosine.to(device), self.size.to(device)

    def colors(self, views: Int[Tensor, "views"], numbers: Sequence[int]) -> ViewTable:
        """Return the colors of views in [0, 1], over the background of evaluation.

        Args:
            views: indices, on the device that these tables were moved to.
            numbers: the same, on the host.
        """
        pictures = self._pictures(numbers, views.device)
        return _table([picture.flatten(0, 1) for picture in pictures], self.size[views], 1)

    def features(self, views: Int[Tensor, "views"], numbers: Sequence[int], network: ImageNetwork) -> ViewTable:
        """Return the features of views, specified as for `colors`, with gradients if they are enabled."""
        device = views.device
        if torch.is_grad_enabled():
            found = self._made(numbers, network, device)
        else:
            made = functools.partial(self._made, network=network, device=device)
            found = self._features.get(numbers, made, device, _state_of(network))
        return _table(found, -(-self.size[views] // network.scale), network.scale)

    def _made(self, views: Sequence[int], network: ImageNetwork, device: torch.device) -> list[Tensor]:
        pictures = self._pictures(views, device)
        found: dict[int, Tensor] = {}
        sizes = [picture.shape for picture in pictures]
        for size in dict.fromkeys(sizes):
            alike = [number for number, each in enumerate(sizes) if each == size]
            for start in range(0, len(alike), AT_ONCE):
                part = alike[start : start + AT_ONCE]
                maps = network(torch.stack([pictures[number] for number in part]).permute(0, 3, 1, 2))
                rows = maps.permute(0, 2, 3, 1).flatten(1, 2)
                found |= dict(zip(part, rows.unbind(), strict=True))
        return [found[number] for number in range(len(views))]

    def _pictures(self, views: Sequence[int], device: torch.device) -> list[Tensor]:
        def make(lacking: Sequence[int]) -> list[Tensor]:
            behind = background_colors(self.photographs.background, 1, torch.device("cpu"), random=None)
            pixels = self.photographs.pixels
            return [blend(pixels.view(view).cpu().float() / 255.0, behind).to(device) for view in lacking]

        return self._colors.get(views, make, device)


class _Cache:
    # A cache of the most recent results, up to `CACHE_BYTES`.
    def __init__(self) -> None:
        self.of: OrderedDict[tuple[int, torch.device], Tensor] = OrderedDict()
        self.state: object = None
        self.lock = threading.Lock()  # tiles are rendered in parallel

    def get(
        self,
        views: Sequence[int],
        make: Callable[[Sequence[int]], list[Tensor]],
        device: torch.device,
        state: object = None,
    ) -> list[Tensor]:
        with self.lock:
            if state != self.state:
                self.of.clear()
                self.state = state
            lacking = [view for view in views if (view, device) not in self.of]
            found = {view: self.of[view, device] for view in views if (view, device) in self.of}
            found |= dict(zip(lacking, make(lacking), strict=True)) if lacking else {}
            for view in views:
                self.of[view, device] = found[view]
                self.of.move_to_end((view, device))
            while sum(each.nbytes for each in self.of.values()) > CACHE_BYTES:
                self.of.popitem(last=False)
            return [found[view] for view in views]


def _table(of_views: Sequence[Tensor], size: Int[Tensor, "views 2"], scale: int) -> ViewTable:
    count = size.prod(dim=1)
    return ViewTable(torch.cat(list(of_views)), count.cumsum(0) - count, size, scale)


def _state_of(network: nn.Module) -> object:
    # Changes whenever a weight is modified or replaced.
    return tuple((weight.data_ptr(), weight._version) for weight in network.parameters())

"""The photographs of a capture in the viewer: small ones for the frusta, larger ones to compare with."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.types.scene import Background, Scene, SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

THUMBNAIL = 96
MOST_FRUSTA = 150  # More frusta occlude each other, and slow down the page.


class Photographs:
    """The photographs of a checkpoint's cameras.

    `scene` is the capture, read again, whose views are matched by name; None: there are no pictures.
    """

    def __init__(self, record: SceneRecord, scene: Scene | None, background: Background):
        self.record, self.background = record, background
        self.when_read: list[Callable[[], None]] = []
        """Callbacks for when pictures become available."""
        self.take(scene)

    def take(self, scene: Scene | None) -> None:
        """Show the pictures of a capture from now on."""
        self.scene = scene
        self._views = {} if scene is None else {name: view for view, name in enumerate(scene.view_names)}
        for act in self.when_read:
            act()

    @property
    def frustum_views(self) -> list[int]:
        """The views that get a frustum: all, or evenly chosen ones of very many."""
        count = len(self.record.view_names)
        if count <= MOST_FRUSTA:
            return list(range(count))
        return torch.linspace(0, count - 1, MOST_FRUSTA).round().int().tolist()

    def has(self, view: int) -> bool:
        """Return whether there is a picture of this view of the checkpoint."""
        return self.record.view_names[view] in self._views

    def picture(self, view: int, width: int, height: int) -> UInt8[Tensor, "height width 3"]:
        """Return a photograph in this size (pixels)."""
        assert self.scene is not None
        rgba = self.scene.pixels.view(self._views[self.record.view_names[view]])
        # Most pixels of a large photograph need not be read; two per shown pixel are smooth enough.
        step = max(1, min(rgba.shape[0] // (2 * height), rgba.shape[1] // (2 * width)))
        behind = background_colors(self.background, 1, torch.device("cpu"), random=None)
        whole = to_bytes(blend(rgba[::step, ::step].float() / 255.0, behind))
        small = Image.fromarray(whole.numpy()).resize((width, height), Image.Resampling.BOX)
        return torch.from_numpy(np.array(small))

    def thumbnail(self, view: int) -> UInt8[Tensor, "height width 3"] | None:
        """Return a small picture for a frustum; None if there is no photograph."""
        if not self.has(view):
            return None
        width, height = (int(size[view]) for size in (self.record.cameras.width, self.record.cameras.height))
        shrunk = THUMBNAIL / max(width, height)
        return self.picture(view, max(1, round(width * shrunk)), max(1, round(height * shrunk)))

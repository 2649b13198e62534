"""The memory that a frame of a film takes: one that would not fit is refused before the first."""

from collections.abc import Sequence

from nerf_lightning import ranks
from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.commands.film_settings import FilmSettings
from nerf_lightning.commands.strategy import processes_here
from nerf_lightning.free_memory import require_memory
from nerf_lightning.types.scene import Cameras

# Bytes per pixel, measured on the CPU. All rays of a frame are made at once; these are they, and the picture rendered:
PLAIN = 140
# where rays are cut, or looked at a second time for normals or for another camera's colour;
TWICE = 260
# where they go through normalised device coordinates.
BENT = 400
# What is shown of it: a panel, its caption and its place in the frame.
PANEL = 16


def bytes_per_pixel(settings: FilmSettings, scenes: Sequence[SceneRecord]) -> int:
    """Return what a frame takes for each pixel of a panel; models are rendered one after the other."""
    bent = any(scene.cameras.ndc is not None for scene in scenes)
    twice = settings.hold_camera or settings.crop is not None or settings.near is not None
    picture = BENT if bent else TWICE if twice or "normals" in settings.outputs else PLAIN
    return picture + PANEL * len(settings.outputs) * len(scenes)


def require_room(cameras: Cameras, settings: FilmSettings, scenes: Sequence[SceneRecord]) -> None:
    """Refuse frames that take more memory than can be had.

    Args:
        cameras: of the path, all of one size.
        settings: what is filmed.
        scenes: those of the models that are filmed side by side.

    Raises:
        InputError: in all processes; it says which size would fit.
    """
    width, height = int(cameras.width[0]), int(cameras.height[0])
    together = processes_here() if ranks.world_size() > 1 else 1
    each = together * bytes_per_pixel(settings, scenes)

    def tall(wide: int) -> int:
        return max(1, round(height * wide / width))

    ranks.from_first(
        lambda: require_memory(
            f"A frame of {width} x {height} pixels is rendered as a whole",
            width,
            lambda wide: each * wide * tall(wide),
            lambda wide: f"path.width={wide} path.height={tall(wide)}",
        )
    )

"""An exporter that needs photographs: the mean color of each, beside that of the model's picture of it."""

from pathlib import Path

from nerf_lightning.export.base import MODEL_ALONE, Export, RunContext
from nerf_lightning.files.json_files import write_json
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.nerf.types.scene import SceneRecord


class MeanColorsExport(Export):
    """Write `mean_colors.json`: view -> [photograph, picture], each red, green, blue."""

    needs_photographs = True
    needs_density = False

    def __init__(self, split: str = "test"):
        self.split = split

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the file; empty where the photographs cannot be read."""
        scene, found = run.photographs, {}
        for view in scene.splits[self.split] if scene is not None else ():
            rays = RayGenerator(scene.cameras, scene.near, scene.far)
            picture = render_picture(model, rays, view, scene.background, tile_points).rgb
            both = (photograph(scene, view, scene.background), picture)
            found[scene.view_names[view]] = [each.mean(dim=(0, 1)).tolist() for each in both]
        write_json(folder / "mean_colors.json", found)
        return [folder / "mean_colors.json"]

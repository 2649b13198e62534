"""`nerf render`: read a checkpoint, follow a camera path, write what is seen."""

from omegaconf import DictConfig

from nerf_lightning.checkpoints import read_checkpoint
from nerf_lightning.commands.build import build, load_model
from nerf_lightning.commands.filming import film
from nerf_lightning.commands.output_folder import beside_checkpoint, output_folder
from nerf_lightning.data.checks import known_background


def render(config: DictConfig) -> None:
    """Film a checkpoint; it is all that is needed."""
    settings = build(config.trainer)
    settings.prepare_machine()
    checkpoint = read_checkpoint(config.ckpt)
    settings.keep_tile(checkpoint.tile_points)
    model = load_model(checkpoint).to(settings.device)
    path = build(config.path)
    folder = output_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "render"))
    background = known_background(config.background or checkpoint.scene.background)
    with settings.inference():
        written = film(model, checkpoint.scene, path, background, settings.inference_tile_points, folder, config.format)
    print("\n".join(str(file) for file in written))

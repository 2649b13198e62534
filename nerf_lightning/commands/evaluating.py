"""`nerf eval`: read a checkpoint and a scene, measure, print."""

from omegaconf import DictConfig

from nerf_lightning.checkpoints import read_checkpoint
from nerf_lightning.commands.build import build, load_model
from nerf_lightning.commands.finish import metric_lines
from nerf_lightning.commands.output_folder import beside_checkpoint, output_folder
from nerf_lightning.commands.recorded_frame import in_recorded_frame


def evaluate(config: DictConfig) -> float:
    """Measure a checkpoint on a split of a scene; return the PSNR."""
    settings = build(config.trainer)
    settings.prepare_machine()
    checkpoint = read_checkpoint(config.ckpt)
    settings.keep_tile(checkpoint.tile_points)
    model = load_model(checkpoint).to(settings.device)
    folder = output_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "evaluation"))
    scene = in_recorded_frame(build(config.scene).read(), checkpoint.scene)
    with settings.inference():
        metrics = build(config.evaluation).score(model, scene, scene.background, settings.inference_tile_points, folder)
    print("\n".join(metric_lines(metrics, folder)))
    return float(metrics["psnr"])

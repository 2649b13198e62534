"""Learn a radiance field from photographs with known cameras."""

from omegaconf import DictConfig


def run(config: DictConfig) -> float | None:
    """Train, and return the test PSNR (the validation's where no evaluation follows), which sweepers may maximise."""
    # Imported late: torch and Lightning take seconds, and --help needs neither.
    from nerf_lightning.commands.training import train

    return train(config)

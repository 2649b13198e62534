"""Learn a radiance field from photographs with known cameras."""

from pathlib import Path

from omegaconf import DictConfig


def prepare(arguments: list[str]) -> list[str]:
    """Repeat the overrides that a run was started with where it is resumed by name; the user's own come after them."""
    resumed = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    if not resumed or resumed[-1] in ("auto", "null"):
        return arguments
    path = Path(resumed[-1].strip("'\""))
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    # Imported late: --help needs no parser of overrides.
    from nerf_lightning.commands.former_overrides import former_overrides

    return [*former_overrides(folder, arguments), *arguments]


def run(config: DictConfig) -> float | None:
    """Train, and return the test PSNR (the validation's where no evaluation follows), which sweepers may maximise."""
    # Imported late: torch and Lightning take seconds, and --help needs neither.
    from nerf_lightning.commands.processes import on_all_processes
    from nerf_lightning.commands.training import train

    return on_all_processes("train", config, train)

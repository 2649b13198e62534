"""Learn a radiance field from photographs with known cameras."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

# What belongs to one start of a run, not to the run.
OF_ONE_START = ("resume=", "paths.", "init_from=")


def prepare(arguments: list[str]) -> list[str]:
    """Repeat the overrides that a run was started with where it is resumed by name; the user's own come after them."""
    resumed = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    if not resumed or resumed[-1] in ("auto", "null"):
        return arguments
    path = Path(resumed[-1].strip("'\""))
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    saved = folder / ".hydra" / "overrides.yaml"
    if not saved.is_file():
        return arguments
    former = [str(override) for override in OmegaConf.load(saved) if not str(override).startswith(OF_ONE_START)]
    return [*former, *arguments]


def run(config: DictConfig) -> float | None:
    """Train, and return the test PSNR (the validation's where no evaluation follows), which sweepers may maximise."""
    # Imported late: torch and Lightning take seconds, and --help needs neither.
    from nerf_lightning.commands.processes import on_all_processes
    from nerf_lightning.commands.training import train

    return on_all_processes("train", config, train)

"""Learn a radiance field from photographs with known cameras."""

from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.commands.slurm import was_requeued
from nerf_lightning.errors import InputError
from nerf_lightning.loading import quick_imports


def prepare(arguments: list[str]) -> list[str]:
    """Repeat the overrides that a run was started with where it is resumed by name; the user's own come after them.

    Raises:
        InputError: a sweep would begin where one has been.
    """
    _refuse_second_sweep(arguments)
    resumed = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    if not resumed or resumed[-1] in ("auto", "null"):
        return arguments
    path = Path(resumed[-1].strip("'\""))
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    # Imported late: --help needs no parser of overrides.
    from nerf_lightning.commands.former_overrides import former_overrides

    return [*former_overrides(folder, arguments), *arguments]


def _refuse_second_sweep(arguments: list[str]) -> None:
    values = dict(argument.partition("=")[::2] for argument in arguments)
    folder = Path(values.get("hydra.sweep.dir", "").strip("'\""))
    goes_on = values.get("sweep.resume", "").lower() == "true" or was_requeued()
    if "hydra.sweep.dir" in values and not goes_on and next(folder.glob("*/run.json"), None) is not None:
        raise InputError(
            f"{folder} already holds runs of a sweep. Add sweep.resume=true to go on with it or to add to it, or give "
            "another folder with paths.output_dir=DIR."
        )


def run(config: DictConfig) -> float | None:
    """Train, and return the test PSNR (the validation's where no evaluation follows), which sweepers may maximise."""
    # Imported late: torch and Lightning take seconds, and --help needs neither.
    with quick_imports():
        from nerf_lightning.commands.preemption import preemptible
        from nerf_lightning.commands.processes import on_all_processes
        from nerf_lightning.commands.training import train

    with preemptible():
        return on_all_processes("train", config, train)

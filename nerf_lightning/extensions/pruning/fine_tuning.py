"""Training after pruning: that of the run again, with the narrower widths, from the remaining weights."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.commands.train import run as train
from nerf_lightning.config.auto_settings import AUTO, chosen_numbers
from nerf_lightning.config.compose import compose_config, composed_job
from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.overrides import open_sections, quoted
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.files.folders import option_names
from nerf_lightning.files.yaml_files import plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.command_folder import beside_checkpoint
from nerf_lightning.runs.saved_overrides import former_overrides


def fine_tuning(checkpoint: Checkpoint, widths: Mapping[str, int], steps: int) -> list[str] | None:
    """Return the overrides of `nerf train` that fine-tune a narrower model; None if it takes no steps.

    They are those of the checkpoint's run, as far as a file may set them, and the widths.

    Args:
        checkpoint: the pruned one.
        widths: of the narrower fields, by module name.
        steps: number of steps.

    Raises:
        InputError: an invalid number of steps, or the run's folder does not say how it was trained.
    """
    if steps < 0:
        raise InputError(f"finetune_steps={steps}: give a whole number, 0 for none.")
    if not steps:
        return None
    folder = beside_checkpoint(checkpoint.path, ".hydra").parent if checkpoint.path.is_file() else checkpoint.path
    if not (folder / ".hydra" / "overrides.yaml").is_file():
        raise InputError(
            f"finetune_steps={steps}: {folder} has no .hydra/overrides.yaml, which says how {checkpoint.path.name} was "
            f"trained. Leave it out, and fine-tune with nerf train, the run's settings, {_format_widths(widths)} and "
            "init_from=CHECKPOINT."
        )
    # What a run does only at its start, showing the pictures' centers first, is for untrained weights.
    length = [f"trainer.max_steps={steps}", "trainer.max_epochs=null", "budget.seconds=null", "data.crop_steps=0"]
    former = open_sections([*former_overrides(folder, length), *length])
    begun = compose_config("train", former)
    config = begun.config
    if begun.choices.get("model") == AUTO:  # the choices for the scene
        picked = {group: checkpoint.choices.get(group) for group in ("model", "loss")}
        former += [f"{group}={name}" for group, name in picked.items() if name in option_names(group)]
        former += chosen_numbers(plain_yaml(checkpoint.config, f"The config in {checkpoint.path}"))
        config = compose_config("train", former).config
    model = OmegaConf.to_container(config.model, resolve=False)
    return [*former, *dict.fromkeys(f"{_setting(model, name)}={width}" for name, width in widths.items())]


def fine_tune(overrides: list[str], checkpoint: Path, folder: Path) -> float | None:
    """Train with the overrides of `fine_tuning` from a checkpoint into a new run folder; return the PSNR (dB)."""
    places = [f"init_from={quoted(str(checkpoint))}", f"paths.output_dir={quoted(str(folder))}"]
    with in_words("train"), composed_job("train", [*overrides, *places]) as config:
        set_limits(Budgets(**config.budgets))
        return train(config)


def _setting(model: Any, field: str) -> str:
    """Return the setting of a field's width: that of the section that it is composed from, if any."""
    node = model
    for name in field.split("."):
        node = node.get(name) if isinstance(node, dict) else None
    return f"{node[2:-1]}.width" if isinstance(node, str) else f"model.{field}.width"


def _format_widths(widths: Mapping[str, int]) -> str:
    return ", ".join(f"model.{name}.width={width}" for name, width in widths.items()) or "the same widths"

"""Write a smaller checkpoint: fewer neurons per hidden layer, quantized hash tables."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nerf_lightning import __version__
from nerf_lightning.checkpoints.format import KEY, LAST
from nerf_lightning.checkpoints.reading import Checkpoint, read_content
from nerf_lightning.checkpoints.writing import write_checkpoint
from nerf_lightning.config.instantiate import require_fitting
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.open_checkpoint import open_checkpoint
from nerf_lightning.config.overrides import to_type
from nerf_lightning.extensions.pruning.fine_tuning import fine_tune, fine_tuning
from nerf_lightning.extensions.pruning.narrower_model import shapes_of, widths_of, with_widths
from nerf_lightning.extensions.pruning.prune import Pruning, prunable_fields, prune
from nerf_lightning.extensions.pruning.quantize import NumberType
from nerf_lightning.extensions.pruning.quantized_weights import quantized_weights
from nerf_lightning.files.made_folders import child_of, make_folder
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.command_folder import beside_checkpoint, filled_folder

RECORD_KEYS = ("format", "choices", "scene", "refined", "precision", "tile_points")
"""The parts of a checkpoint's record that do not depend on widths or on a running training."""
SETTINGS = {each.name: each.type for each in fields(Pruning)} | {
    "keep": float,
    "tables": NumberType,
    "drop_empty": bool,
    "finetune_steps": int,
}


def run(config: DictConfig) -> float | None:
    """Write a smaller checkpoint, in this process alone, and fine-tune it if requested.

    Returns the PSNR (dB) after fine-tuning, which sweepers may maximize.

    Raises:
        InputError: the checkpoint cannot be read, nothing in it can be removed, or too much would be.
    """
    for name, kind in SETTINGS.items():
        require_fitting(config[name], kind, name)
    pruning = Pruning(**{each.name: config[each.name] for each in fields(Pruning)})
    opened = open_checkpoint(config, float32=True)
    model, wide = opened.model.cpu(), opened.checkpoint
    narrowed = prunable_fields(model)
    if pruning.keep < 1.0 and not narrowed:
        raise InputError(
            f"keep={pruning.keep}: no field of the model in {wide.path} has hidden layers that it could do without "
            "(those of nerf_mlp and hash have). Give keep=1, and tables=... for its hash tables."
        )
    before = widths_of(wide, list(narrowed)) if pruning.keep < 1.0 else {}
    after = {name: pruning.width(width, f"model.{name}") for name, width in before.items()}
    text = with_widths(wide, after)
    weights = prune(model, shapes_of(wide, text, opened.trusted), pruning, wide.scene, opened.tile_points)
    narrow = replace(wide, config=text, weights=weights)
    quantized = quantized_weights(load_model(narrow, opened.trusted), config.tables, config.drop_empty)
    tuning = fine_tuning(wide, after, config.finetune_steps)
    with filled_folder(config.paths.output_dir, beside_checkpoint(wide.path, "pruned")) as folder:
        target, run = make_folder(folder, "checkpoints") / LAST, child_of(folder, "finetuned")
        _require_own(target)
        if tuning is not None and (run / "run.json").exists():
            going_on = f"{to_type('resume', str(run))} {to_type('init_from', str(target))}"
            raise InputError(
                f"{run} already contains a fine-tuning run. Resume it with nerf train {going_on}, or give another "
                "folder with paths.output_dir=DIR."
            )
        write_checkpoint(_content(narrow, quantized), target)
        say(*(f"{name}  {before[name]} -> {width} neurons wide" for name, width in after.items()), _sizes(wide, target))
        return None if tuning is None else fine_tune(tuning, target, run)


def _require_own(target: Path) -> None:
    """Refuse to overwrite anything but a pruned checkpoint: a run's checkpoint has more than weights."""
    try:
        is_own = not target.exists() or "optimizer_states" not in read_content(target)
    except InputError:
        is_own = False
    if not is_own:
        raise InputError(
            f"{target} was not written by nerf prune, and would be lost. Move it away, or give another folder with "
            "paths.output_dir=DIR."
        )


def _content(narrow: Checkpoint, quantized: dict[str, Any]) -> dict[str, Any]:
    """Return the file's content; training cannot resume from it, since an optimizer's state has the wider shapes."""
    elsewhere = {name for part in quantized.values() for name in part}
    state = {f"model.{name}": tensor for name, tensor in narrow.weights.items()}
    record = {key: narrow.record[key] for key in RECORD_KEYS if key in narrow.record}
    record |= {"version": __version__, "config": narrow.config} | ({"quantized": quantized} if elsewhere else {})
    kept = {name: tensor for name, tensor in state.items() if name not in elsewhere}
    return {"state_dict": kept, "global_step": narrow.step, KEY: record}


def _sizes(wide: Checkpoint, target: Path) -> str:
    weights = sum(tensor.numel() * tensor.element_size() for tensor in wide.weights.values())
    return (
        f"{target}  {target.stat().st_size / 1e6:.2f} MB; {wide.path.name} had {weights / 1e6:.2f} MB of weights, "
        f"and {wide.path.stat().st_size / 1e6:.2f} MB with the state for resuming"
    )

"""Add what a run or a checkpoint remembers to a command's arguments before Hydra composes them.

Heavy modules are imported late: `--help` needs none of them.
"""

import logging
from collections.abc import Callable
from pathlib import Path

from nerf_lightning.cli.arguments import named_paths
from nerf_lightning.cli.loading import quick_imports
from nerf_lightning.cli.quoting import unquoted
from nerf_lightning.compute.slurm import was_requeued
from nerf_lightning.messages.errors import InputError

log = logging.getLogger(__name__)


def prepared(command: str, arguments: list[str]) -> list[str]:
    """Return a command's arguments, preceded by the remembered ones; the user's own come last and take precedence."""
    if command in PATHS_ALONE:
        key = PATHS_ALONE[command]
        arguments = named_paths(arguments, key, several=key == "runs")
    prepare = PREPARED.get(command)
    return arguments if prepare is None else prepare(arguments)


def _train(arguments: list[str]) -> list[str]:
    """Repeat a run's original overrides if it is resumed by name; accept Lightning's arguments."""
    _refuse_second_sweep(arguments)
    resumed = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    from nerf_lightning.config.overrides import open_sections

    arguments = open_sections(arguments)
    if not resumed or resumed[-1] in ("auto", "null"):
        return arguments
    path = Path(unquoted(resumed[-1]))
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    from nerf_lightning.runs.saved_overrides import former_overrides

    return [*former_overrides(folder, arguments), *arguments]


def _refuse_second_sweep(arguments: list[str]) -> None:
    values = dict(argument.partition("=")[::2] for argument in arguments)
    folder = Path(unquoted(values.get("hydra.sweep.dir", "")))
    goes_on = values.get("sweep.resume", "").lower() == "true" or was_requeued()
    if "hydra.sweep.dir" in values and not goes_on and next(folder.glob("*/run.json"), None) is not None:
        raise InputError(
            f"{folder} already holds runs of a sweep. Add sweep.resume=true to resume it or to add to it, or give "
            "another folder with paths.output_dir=DIR."
        )


def _eval(arguments: list[str]) -> list[str]:
    """Add the run's own scene if the user names none, so that the checkpoint suffices.

    The scene's class comes from our conf/, by the name that the checkpoint recorded; only plain values (paths, sizes,
    background) are taken from the file.
    """
    given = [argument.partition("=") for argument in arguments]
    checkpoints = [value for key, _, value in given if key == "ckpt"]
    if not checkpoints or any(key in ("scene", "--help") for key, _, _ in given):
        return arguments
    checkpoint = unquoted(checkpoints[-1])
    if "," in checkpoint and checkpoint == checkpoints[-1]:
        raise InputError("A sweep over checkpoints needs the scene by name: add scene=... and its settings.")
    with quick_imports():
        from nerf_lightning.config.scene_overrides import scene_overrides

    return [*scene_overrides(checkpoint), *arguments]


def _view(arguments: list[str]) -> list[str]:
    """Add the run's own scene as for `eval`; without it, show cameras without photographs unless they are requested."""
    wished = [value for key, _, value in (each.partition("=") for each in arguments) if key == "photographs"]
    if "true" in map(str.lower, wished[-1:]):
        return _eval(arguments)
    said = "" if wished else "The cameras are shown without their photographs"
    return _eval_or_without(arguments, ["photographs=false"], said)


def _export(arguments: list[str]) -> list[str]:
    """Add the run's own scene as for `eval` if the exporter needs photographs; if it is unknown, do without."""
    typed = [value for key, _, value in (each.partition("=") for each in arguments) if key == "what"]
    with quick_imports():
        from nerf_lightning.config.exporters import exporter_class
        from nerf_lightning.config.help.catalogue import command_named

        if not typed:
            command = command_named("export")
            assert command is not None
            typed = [str(dict(command.groups)["what"])]
        name = typed[-1]
        exporter = exporter_class(name)
    # The user's own exporter is unknown here: it may need photographs.
    if exporter is not None and not getattr(exporter, "needs_photographs", False):
        return arguments
    return _eval_or_without(arguments, ["photographs=false"], f"what={name} does not use photographs")


def _eval_or_without(arguments: list[str], without: list[str], said: str) -> list[str]:
    """Add the run's own scene as for `eval`; if it is unknown, log `said` (unless empty) and do without."""
    try:
        return _eval(arguments)
    except InputError as error:
        from nerf_lightning.config.scene_overrides import UnknownScene

        if not isinstance(error, UnknownScene):
            raise
        if said:
            log.warning("%s: %s", said, error)
        return [*without, *arguments]


def _report(arguments: list[str]) -> list[str]:
    """Add the run's own scene if the user names none."""
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if "run" not in given or "scene" in given or given.get("doctor", "").lower() == "false":
        return arguments
    from nerf_lightning.config.scene_overrides import scene_overrides

    try:
        recorded = scene_overrides(str(Path(unquoted(given["run"])) / "checkpoints" / "last.ckpt"))
    except InputError:
        return arguments  # the page says so
    return [*recorded, *arguments]


PREPARED: dict[str, Callable[[list[str]], list[str]]] = {
    "train": _train,
    "eval": _eval,
    "view": _view,
    "export": _export,
    "report": _report,
}

PATHS_ALONE = {"table": "runs", "report": "run", **dict.fromkeys(("eval", "render", "view", "export"), "ckpt")}
"""Commands that accept paths without a key, and the setting that such paths fill."""

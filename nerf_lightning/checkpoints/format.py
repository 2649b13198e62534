"""The format of a checkpoint, key by key: writing and reading check against the same annotations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from jaxtyping import Float64, Int, jaxtyped
from packaging.version import Version
from torch import Tensor

from nerf_lightning import __version__
from nerf_lightning.checkpoints.quantization import Quantized
from nerf_lightning.compute.cores import MOST_THREADS
from nerf_lightning.data.captures.checks import check_cameras, check_scene
from nerf_lightning.files.trust import Mismatch, for_message, require_fit
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord

LAST, PREVIOUS, BEST = "last.ckpt", "previous.ckpt", "best.ckpt"
"""Names of the files in a run's checkpoints/."""
DAMAGED = "damaged.ckpt"
FORMAT = 7
KEY = "nerf_lightning"
PARTS = ("model.", "rays.", "correction.", "loss.")
"""Parts of a training step: the prefixes of their weights' names."""
LOOPS = ("fit_loop", "validate_loop", "test_loop", "predict_loop")
"""Lightning's."""
LIGHTNING = "pytorch-lightning_version"
Precision = Literal["32-true", "tf32", "bf16-mixed"]
PRECISIONS = get_args(Precision)

RECORD: dict[str, Any] = {
    "format": Literal[7],
    "version": str,
    "config": str,
    "choices": dict[str, str],
    "scene": SceneRecord,
    "precision": Precision,
    "tile_points": Annotated[int, 1, 1 << 31] | None,
}
OF_A_RUN: dict[str, Any] = {
    "progress": Progress,
    "bad_steps": list[int],
    "num_threads": Annotated[int, 1, MOST_THREADS],
    "world_size": int,
}
OPTIONAL: dict[str, Any] = {
    "refined": Cameras,
    "pixels": Int[Tensor, "views"],
    "depths": Float64[Tensor, "views 4"],
    "quantized": Quantized,
}
FILE: dict[str, Any] = {"state_dict": dict[str, Tensor], "global_step": int, KEY: object}
TRAINING: dict[str, Any] = {
    "epoch": int,
    LIGHTNING: str,
    "loops": dict[str, object],
    "callbacks": dict[str, object],
    "optimizer_states": list[dict[str, object]],
    "lr_schedulers": list[object],
}
"""What training resumes from, besides the record; the resuming run checks it against its own
(`training/restore.py`)."""
OF_SUBCLASSES: dict[str, Any] = {"hyper_parameters": object, "hparams_name": object, "hparams_type": object}
"""What `save_hyperparameters` of a user's subclass adds; nothing here reads it."""
OF_AVERAGING: dict[str, Any] = {"current_model_state": dict[str, Tensor], "averaging_state": dict[str, Tensor]}
"""What Lightning's WeightAveraging adds and restores; `state_dict` then holds the averages."""


def require_our_format(content: Mapping[str, Any], path: Path) -> None:
    """Refuse a file that is not a checkpoint of this program, or has another format.

    Raises:
        InputError: in either case.
    """
    record = content.get(KEY)
    if not isinstance(record, dict) or "state_dict" not in content:
        raise InputError(
            f"{path} is a file of PyTorch's, but not a checkpoint of nerf_lightning. "
            "Give the checkpoints/last.ckpt or checkpoints/best.ckpt of a run folder."
        )
    written, version = record.get("format"), for_message(record.get("version")).strip("'")
    if type(written) is not int or written != FORMAT:
        raise InputError(
            f"{path} has checkpoint format {for_message(written)} (written by nerf_lightning {version}), "
            f"and this version, {__version__}, reads format {FORMAT}. Use the version that wrote it, or train again."
        )


def require_checkpoint(content: dict[str, Any], where: str) -> None:
    """Check a checkpoint against the format.

    Raises:
        Mismatch: names the first key that is missing, unknown or invalid.
        InputError: it exceeds the budgets.
    """
    require_fit(content, FILE, "", TRAINING | OF_SUBCLASSES | OF_AVERAGING)
    for name in content["state_dict"]:
        if not name.startswith(PARTS):
            raise Mismatch(f"state_dict.{name}", "belongs to no part of a run")
    record = content[KEY]
    with jaxtyped("context"):  # `views` is one number in all shapes
        require_fit(record, RECORD, KEY, OF_A_RUN | OPTIONAL)
    scene = record["scene"]
    names, cameras = scene["view_names"], scene["cameras"]["width"]
    if not scene["near"].shape == cameras.shape == (len(names),):
        raise Mismatch("scene.view_names", f"names {len(names)} views, and there are {cameras.numel()} cameras")
    check_scene(scene_of(record), where)
    if "refined" in record:
        check_cameras(Cameras(**record["refined"]), "refined", where)


def scene_of(record: Mapping[str, Any]) -> SceneRecord:
    """Return the scene in a checkpoint's record, with the cameras as read."""
    return SceneRecord(**record["scene"] | {"cameras": Cameras(**record["scene"]["cameras"])})


def require_training_state(content: Mapping[str, Any], path: Path) -> None:
    """Refuse a checkpoint that training cannot resume from.

    Raises:
        InputError: it holds weights without training state.
        Mismatch: names the first missing key of that state.
    """
    if missing := TRAINING.keys() - content.keys():
        raise InputError(
            f"{path} holds weights without the state of a training ({listed(sorted(missing), 3)}), as Lightning's "
            "save_weights_only=True and nerf prune save it. It can be rendered, evaluated and exported, but not "
            "resumed. Resume another checkpoint of the run, or start a new run from these weights (init_from=FILE)."
        )
    for key in OF_A_RUN.keys() - content[KEY].keys():  # those present have been checked
        raise Mismatch(f"{KEY}.{key}", "is missing")
    if Version(content[LIGHTNING]) < Version("2.0"):
        raise Mismatch(LIGHTNING, "is of a version that this program has never used")

"""The scalars of a run, from its TensorBoard files."""

import logging
import tempfile
from pathlib import Path

from nerf_lightning.errors import InputError
from nerf_lightning.files.regular import read_bytes

MOST_BYTES = 1 << 29
MOST_POINTS = 1000


def read_curves(folder: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Return steps and values of every scalar, thinned out where there are more than a drawing shows.

    Raises:
        InputError: there are none, or more than is read, or the files are damaged.
    """
    files = [file for file in folder.glob("*tfevents*") if not file.is_dir()]
    if not files:
        raise InputError("there are no TensorBoard files (logger=none)")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    # 0 would keep all of a kind: one of those that are not wanted is the least.
    kinds = dict.fromkeys(("compressedHistograms", "images", "audio", "histograms", "tensors", "graph"), 1)
    # TensorBoard opens whatever lies in a folder, by its name.
    with tempfile.TemporaryDirectory(prefix="nerf-curves-") as copies:
        _copy(files, Path(copies))
        try:
            log = EventAccumulator(copies, size_guidance=kinds | {"scalars": MOST_POINTS}).Reload()
            curves = {
                tag: [(event.step, float(event.value)) for event in log.Scalars(tag)] for tag in log.Tags()["scalars"]
            }
        except Exception as error:  # a stranger's records can fail in any way
            raise InputError(f"the TensorBoard files cannot be read ({type(error).__name__})") from error
    return {tag: ([step for step, _ in points], [value for _, value in points]) for tag, points in curves.items()}


def _copy(files: list[Path], folder: Path) -> None:
    left = MOST_BYTES
    for file in files:
        content = read_bytes(file, left, "Leave it out of the folder.")
        left -= len(content)
        (folder / file.name).write_bytes(content)

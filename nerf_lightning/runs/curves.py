"""The curves of a run, read from its TensorBoard files, which may be anybody's."""

import logging
import tempfile
from pathlib import Path

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.errors import InputError

MOST_POINTS = 1000


def read_curves(folder: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Return steps and values of every scalar, thinned out where there are more than a drawing shows."""
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
            tags = log.Tags()["scalars"]
            curves = {tag: [(event.step, float(event.value)) for event in log.Scalars(tag)] for tag in tags}
        except Exception as error:  # a stranger's records can fail in any way
            raise InputError(f"the TensorBoard files cannot be read ({type(error).__name__})") from error
    return {tag: ([step for step, _ in points], [value for _, value in points]) for tag, points in curves.items()}


def _copy(files: list[Path], folder: Path) -> None:
    size = values = 0
    for file in files:
        content = read_bytes(file, "event", "Leave it out of the folder.")
        # A scalar and its tag begin with the byte 10 each; so may, by chance, one byte in 256 of a picture.
        size, values = size + len(content), values + content.count(b"\n")
        require_within("event_bytes", size, file.parent, "bytes of TensorBoard files")
        require_within("event_values", values, file.parent, "values in its TensorBoard files")
        (folder / file.name).write_bytes(content)

"""Saving in parallel with training: training waits for a copy in memory, and a separate thread writes the file."""

import logging
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from lightning.pytorch.plugins import TorchCheckpointIO
from lightning_utilities.core.apply_func import apply_to_collection
from torch import Tensor

from nerf_lightning.checkpoints.reading import content_to_resume
from nerf_lightning.checkpoints.writing import write_checkpoint

# Copies in memory: one being written, and one waiting (`last` and `best` may be due at the same step).
MOST_COPIES = 2

log = logging.getLogger(__name__)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Copy a checkpoint to the host's memory, and write it in the background, whole or not at all.

    Lightning's AsyncCheckpointIO lets any number of copies wait, reports a failure only at the next save, and replaces
    our writer with Lightning's own.
    """

    def __init__(self) -> None:
        super().__init__()
        self.writer: ThreadPoolExecutor | None = None
        self.writes: deque[Future[None]] = deque()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Take a copy and return; first wait if too many copies have not been written yet.

        Raises:
            InputError: an earlier write failed.
        """
        while len(self.writes) >= MOST_COPIES:
            self.writes.popleft().result()
        self.raise_failure()
        if self.writer is None:
            self.writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoint")
        # The optimizer changes its tensors in place, and callbacks change their lists: nothing may be shared.
        copy = apply_to_collection(checkpoint, Tensor, _on_the_host)
        self.writes.append(self.writer.submit(write_checkpoint, copy, Path(path)))

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        """Return a checkpoint that training can resume from, on the host: the file is untrusted.

        Raises:
            InputError: it cannot be read, or does not follow `checkpoints.format`.
        """
        return content_to_resume(Path(path))

    def raise_failure(self) -> None:
        """Return at once.

        Raises:
            InputError: a write has failed.
        """
        while self.writes and self.writes[0].done():
            self.writes.popleft().result()

    def wait(self) -> None:
        """Return when everything is on disk.

        Raises:
            InputError: a write has failed.
        """
        while self.writes:
            self.writes.popleft().result()

    def teardown(self) -> None:
        """Wait; the run may be ending with its own error, so failures are only logged."""
        for write in self.writes:
            error = write.exception()
            if error is not None:
                log.error("%s", error)
        self.writes.clear()
        if self.writer is not None:
            self.writer.shutdown()
            self.writer = None


def _on_the_host(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", copy=True)

"""`train.log`: what a run says, kept in its folder."""

import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerf_lightning.files.regular import open_to_append
from nerf_lightning.messages.escaping import EscapingFormatter

FORM = "%(asctime)s %(levelname)s %(name)s: %(message)s"


@contextmanager
def log_file(folder: Path) -> Iterator[None]:
    """Append all that is logged to `train.log` in a run folder.

    Raises:
        InputError: what has this name is no regular file.
        OSError: it cannot be opened.
    """
    with open_to_append(folder / "train.log", "Remove it.") as file:
        # Written as it comes: nothing waits for the end, where a full disk would be an error once more.
        unbuffered: Any = file.raw
        handler = _Handler(io.TextIOWrapper(unbuffered, "utf-8", write_through=True))
        handler.setFormatter(EscapingFormatter(FORM))
        logging.getLogger().addHandler(handler)
        try:
            yield
        finally:
            logging.getLogger().removeHandler(handler)


class _Handler(logging.StreamHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Lose a line that the disk has no room for: the console has it, and what matters is told by who writes it."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

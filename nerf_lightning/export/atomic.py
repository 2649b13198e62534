"""Files that are either whole or not there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Lend a temporary path beside `path` that takes its place when the block ends well, else is removed.

    A missing folder is made. The temporary name keeps the suffix, since writers choose a format by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        part.unlink(missing_ok=True)  # a link of this name, planted or left, would be written through
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)

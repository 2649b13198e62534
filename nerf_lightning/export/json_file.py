"""Json files with what was measured."""

import json
import math
from pathlib import Path
from typing import Any

from nerf_lightning.export.atomic import whole_file


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a json file, whole or not at all; NaN and infinity, for which json has no word, become null."""
    with whole_file(path) as part:
        part.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

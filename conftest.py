"""What all tests share, those of extensions (`nerf_lightning/extensions/NAME/tests`) included."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "tests"))

pytest_plugins = ["support.session"]

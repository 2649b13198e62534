"""The README's Python example runs as it stands, with torch alone."""

import re
import subprocess
import sys
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def python_blocks():
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_example_runs_without_hydra_and_lightning():
    (example, *_) = [block for block in python_blocks() if "RadianceModel" in block]
    check = "\nimport sys\nprint([m for m in ('hydra', 'lightning', 'omegaconf') if m in sys.modules])\n"
    done = subprocess.run([sys.executable, "-c", example + check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *said, imported = done.stdout.splitlines()
    assert imported == "[]"
    assert said[-1] == "torch.Size([1024, 3]) torch.Size([1024])"


def test_the_eight_lines_of_an_encoder_are_an_encoder(tmp_path):
    (example, *_) = [block for block in python_blocks() if "(Encoder)" in block]
    scope = {}
    exec(compile(example, "README.md", "exec"), scope)
    import torch

    encoder = next(value for name, value in scope.items() if name.endswith("Encoder") and name != "Encoder")()
    assert encoder(torch.rand(5, 3)).shape == (5, encoder.out_dim)
    assert len([line for line in example.splitlines() if line.strip()]) <= 14

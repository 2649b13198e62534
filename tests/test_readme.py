"""The README's Python examples run as they stand: one with torch alone, one with Lightning's Trainer."""

import re
import subprocess
import sys
from pathlib import Path

from support.captures import write_npz
from support.running import start_code

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


def test_the_notebooks_example_trains_resumes_and_renders(tmp_path):
    (example,) = [block for block in python_blocks() if "build_run" in block]
    # A small scene and short runs, or it would take minutes.
    capture = write_npz(tmp_path / "capture.npz")
    small = f'"scene=npz", "scene.path={capture}", "data.batch_rays=32", "data.val_rays=32"'
    for given, instead in (
        ('"scene=bricks"', small),
        ("max_steps=500", "max_steps=3"),
        ("max_steps=1000", "max_steps=5"),
    ):
        assert example.count(given) == 1
        example = example.replace(given, instead)
    check = "\nprint(run.system.step.progress.step, system.step.progress.step)\n"
    process = start_code(example + check, cwd=tmp_path)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    *_, shapes, steps = output.splitlines()
    assert shapes == "torch.Size([4, 6, 3]) torch.Size([4, 6])"
    assert steps == "5 0"
    assert "Warning" not in errors
    assert list((tmp_path / "outputs" / "notebook").rglob("*.ckpt"))


def test_the_eight_lines_of_an_encoder_are_an_encoder(tmp_path):
    (example, *_) = [block for block in python_blocks() if "(Encoder)" in block]
    scope = {}
    exec(compile(example, "README.md", "exec"), scope)
    import torch

    encoder = next(value for name, value in scope.items() if name.endswith("Encoder") and name != "Encoder")()
    assert encoder(torch.rand(5, 3)).shape == (5, encoder.out_dim)
    assert len([line for line in example.splitlines() if line.strip()]) <= 14

"""The notebooks in docs/ run from top to bottom, on a smaller scene and for fewer steps."""

import json
import re

import pytest
from support.running import REPOSITORY, start_code

SMALLER = (
    (r"resolution=\d+", "resolution=16"),
    (r"num_train=\d+", "num_train=6"),
    (r"max_steps=\d+", "max_steps=3"),
    (r"data\.crop_steps=\d+", "data.crop_steps=1"),
    (r"width=64\)", "width=8)"),
    (r"num_samples=\d+", "num_samples=8"),
)
AT_THE_END = {
    "first_scene": "assert picture.rgb.shape == (16, 16, 3) and len(plt.get_fignums()) == 3, picture.rgb.shape",
    "own_field_and_loss": (
        "assert run.system.step.progress.step == 3 and len(pictures) == 4\n"
        "trainer.save_checkpoint('own.ckpt')\n"
        "try:\n    nl.load('own.ckpt')\n"
        "except nl.InputError as error:\n    print('refused:', error)"
    ),
}


def test_every_notebook_is_tested():
    assert {path.stem for path in (REPOSITORY / "docs").glob("*.ipynb")} == AT_THE_END.keys()


@pytest.mark.parametrize("name", AT_THE_END)
def test_a_notebook_runs_from_top_to_bottom(name, tmp_path):
    cells = json.loads((REPOSITORY / "docs" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for given, instead in SMALLER:
        code = re.sub(given, instead, code)
    process = start_code(f"{code}\n\n{AT_THE_END[name]}\n", cwd=tmp_path)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors[-3000:]
    assert "dB on test views" in output
    assert name == "first_scene" or "refused: " in output

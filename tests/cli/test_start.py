"""What a run loads before its first step: nothing heavy that it does not need."""

import subprocess
import sys

import pytest
from support.running import FAST, REPOSITORY, start

# Some are there in every installation, some only with extras; none has to do with a step.
NOT_NEEDED = (
    *("pandas", "sklearn", "skimage", "trimesh"),
    *("pycolmap", "viser", "optuna", "sqlalchemy", "joblib", "submitit", "selenium", "IPython", "tensorflow"),
)
CALLBACK = """
import sys
from lightning.pytorch import Callback

class Listed(Callback):
    def on_train_batch_start(self, *given):
        print("loaded:", [name for name in {names} if name in sys.modules])
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize("model", [FAST, (*FAST, "data.crop_steps=0", "model=fast_small")])
def test_nothing_that_a_step_can_do_without_is_loaded_before_it(model, tmp_path):
    (tmp_path / "listed.py").write_text(CALLBACK.format(names=NOT_NEEDED))
    process = start(
        "train", *model, "trainer.max_steps=1", "trainer.tile_points=auto", "trainer.precision=32-true",
        "final.video=false", "final.evaluate=false", "+callbacks.listed._target_=listed.Listed",
        f"paths.output_dir={tmp_path / 'run'}", env={"PYTHONPATH": f"{tmp_path}:{REPOSITORY}"},
    )  # fmt: skip
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out
    assert "loaded: []" in out.splitlines()


def test_a_config_is_composed_without_torch():
    code = (
        "import sys, types; sys.argv = ['nerf', 'train', 'model=fast']\n"
        "from nerf_lightning.cli.main import main\n"
        "heavy = ('torch', 'lightning', 'numba', 'rich')\n"
        "train = sys.modules['nerf_lightning.commands.train'] = types.ModuleType('train')\n"
        "train.run = lambda config: print(config.seed, [name for name in heavy if name in sys.modules])\n"
        "main()"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "0 []"


# What Lightning brings along of these is Lightning's; nothing of ours may ask for them before there is work for them.
FOR_LATER = ("matplotlib", "scipy", "numba", "llvmlite", "imageio", "sympy", "triton", "torchvision")


@pytest.mark.exhaustive
def test_training_imports_nothing_heavy_beside_lightnings_own():
    code = (
        "import sys, lightning.pytorch\n"
        "known = set(sys.modules)\n"
        "import nerf_lightning.commands.train\n"
        "added = {name.partition('.')[0] for name in set(sys.modules) - known}\n"
        f"print(sorted(added.intersection({FOR_LATER})))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"

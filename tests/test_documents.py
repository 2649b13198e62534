"""What README and docs say is true: examples run, commands compose, settings and files that they name are there."""

import itertools
import json
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
import yaml
from lightning import Trainer
from support.browser import layout_faults, opened
from support.captures import write_blender, write_npz
from support.running import FAST, REPOSITORY, start_code

from nerf_lightning import build_run
from nerf_lightning.cli.help import completion, help_on_anything
from nerf_lightning.cli.main import OF_ITSELF, find_commands
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.overrides import open_sections
from nerf_lightning.files.folders import conf_folders

ROOT = Path(__file__).parents[1]
INDEX = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "docs" / page for page in re.findall(r"\]\((\w+\.md)\)", INDEX)]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "AGENTS.md",
    ROOT / "docs" / "llms.txt",
    ROOT / "docs" / "README.md",
    *PAGES,
    *sorted((ROOT / "nerf_lightning" / "extensions").glob("*/README.md")),
]
TAKE_PATHS = ("report", "table")


def blocks(document, language="python"):
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_documents_are_short():
    words = {document: len(document.read_text(encoding="utf-8").split()) for document in DOCUMENTS}
    assert words.pop(ROOT / "README.md") <= 700
    assert {document.name: count for document, count in words.items() if count > 1500} == {}


def ran(code, folder, *replaced):
    """Run an example with a small scene and short runs, or it would take minutes; return what it printed."""
    for given, instead in replaced:
        assert code.count(given) == 1
        code = code.replace(given, instead)
    process = start_code(code, cwd=folder)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert "Warning" not in errors
    return output.splitlines()


def test_the_example_runs_without_hydra_and_lightning():
    (example, *_) = [block for block in blocks("docs/python.md") if "RadianceModel" in block]
    check = "\nimport sys\nprint([m for m in ('hydra', 'lightning', 'omegaconf') if m in sys.modules])\n"
    done = subprocess.run([sys.executable, "-c", example + check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *said, imported = done.stdout.splitlines()
    assert imported == "[]"
    assert said[-1] == "torch.Size([1024, 3]) torch.Size([1024])"


def test_the_notebooks_example_trains_resumes_and_renders(tmp_path):
    (example,) = [block for block in blocks("docs/python.md") if "Trainer(" in block]
    capture = write_npz(tmp_path / "capture.npz")
    small = f'"scene=npz", "scene.path={capture}", "data.batch_rays=32", "data.val_rays=32"'
    shorter = ('"scene=bricks"', small), ("max_steps=500", "max_steps=3"), ("max_steps=1000", "max_steps=5")
    check = "\nprint(run.system.train_step.progress.step, system.train_step.progress.step)\n"
    *_, shapes, steps = ran(example + check, tmp_path, *shorter)
    assert shapes == "torch.Size([4, 6, 3]) torch.Size([4, 6])"
    assert steps == "5 0"
    assert list((tmp_path / "outputs" / "notebook").rglob("*.ckpt"))


def test_the_example_of_the_surface_reads_trains_loads_and_renders(tmp_path):
    (example,) = [block for block in blocks("docs/python.md") if "nl.train" in block]
    capture = write_blender(tmp_path, {"train": 3, "val": 1, "test": 1})
    small = ", ".join(f'"{each}"' for each in (*FAST, "final.video=false"))
    smaller = (
        ('"data/fox", downscale=2', f'"{capture}"'),
        ("data/fox", str(capture)),
        ('"scene.downscale=2", "trainer.max_steps=800"', small),
        ("num_frames=2)", "num_frames=2, width=4)"),
    )
    assert ran(example, tmp_path, *smaller)[-1] == "torch.Size([8, 8, 3]) torch.Size([8, 8]) torch.Size([8, 8])"


def test_the_example_of_the_readme_trains_loads_and_renders(tmp_path):
    (example,) = [block for block in blocks("README.md") if "nl.train" in block]
    capture = write_blender(tmp_path, {"train": 3, "val": 1, "test": 1})
    small = ", ".join(f'"{each}"' for each in (*FAST, "scene=blender", f"scene.root={capture}", "final.video=false"))
    given = '"scene=bricks", "model=fast_small", "trainer.max_steps=300"'
    smaller = (given, small), ("num_frames=8", "num_frames=2, width=4")
    assert ran(example, tmp_path, *smaller)[-1].startswith("torch.Size([")


def test_the_example_of_cameras_in_memory_trains_and_resumes_to_the_bit(tmp_path):
    (example,) = [block for block in blocks("docs/python.md") if "from_cameras" in block]
    example = example.replace("steps(20)", "steps(4)")
    assert ran(example, tmp_path, ("== 10", "== 2"))[-1] == "4 True"


@pytest.mark.parametrize("document", ["README.md", "docs/extending.md"])
def test_the_few_lines_of_an_encoder_are_an_encoder(document):
    (example,) = [block for block in blocks(document) if "(Encoder)" in block]
    settings = yaml.safe_load(next(block for block in blocks(document, "yaml") if "my_parts." in block))
    scope = {}
    exec(compile(example, document, "exec"), scope)
    encoder = scope[settings.pop("_target_").removeprefix("my_parts.")](**settings)
    assert encoder(torch.ones(5, 3)).tolist() == [[2.0] * encoder.out_dim] * 5
    assert len([line for line in example.splitlines() if line.strip()]) <= 14


def test_the_experiment_of_ones_own_composes(tmp_path):
    (example,) = blocks("docs/experiments.md", "yaml")
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "castle.yaml").write_text(example, encoding="utf-8")
    asked = compose_config("train", [f"hydra.searchpath=[file://{tmp_path}]", "experiment=castle"])
    config = asked.config
    assert (config.scene.root, config.trainer.max_steps, asked.choices["model"]) == (
        "data/castle",
        5000,
        "fast_proposal",
    )


def test_the_loss_in_a_file_of_ones_own_trains(tmp_path, monkeypatch):
    text = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    assert "PYTHONPATH=. nerf train loss._target_=my_losses.L1\n" in text
    (example,) = [block for block in blocks("docs/extending.md") if "(Loss)" in block]
    (tmp_path / "my_losses.py").write_text(example, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    capture = write_npz(tmp_path / "capture.npz")
    small = ("scene=npz", f"scene.path={capture}", "model=nerf_tiny", "data.batch_rays=32", "data.val_rays=32")
    run = build_run(*small, "loss._target_=my_losses.L1")
    Trainer(max_steps=3, accelerator="cpu", logger=False, default_root_dir=tmp_path).fit(run.system, run.data)
    assert type(run.system.train_step.objective.loss).__name__ == "L1"
    assert run.system.train_step.progress.step == 3


def commands():
    """Every `nerf COMMAND ...` that stands in a document, without what only explains it."""
    found = set()
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
        for words in (*lines, *re.findall(r"`([^`\n]+)`", text)):
            match = re.match(r"(?:srun |\.venv-xla/bin/)?nerf ([a-z]+.*)", words)
            if match and not any(
                word in match[1]
                for word in ("...", "--help", "NAME", "encoder=scaled", "scene=table", "experiment=castle")
            ):
                found.add(match[1].split("  #")[0].split(" # ")[0].strip())
    return sorted(found)


@pytest.mark.parametrize("command", commands())
def test_a_command_composes(command):
    name, *words = shlex.split(command)
    if name in OF_ITSELF:
        answer = help_on_anything if name == "help" else completion
        assert answer(words or ["train"] if name == "help" else words, list(find_commands()))
        return
    if "-m" in words:
        # Of each list of choices the first.
        words = [
            re.sub(r"^([\w./@]+=[^\[(,]+),.*", r"\1", word) for word in words if word != "-m" and "tag(" not in word
        ]
    bare = [word for word in words if "=" not in word]
    assert not bare or name in TAKE_PATHS, f"{bare} are no settings"
    compose_config(name, open_sections(word for word in words if "=" in word))


def known_settings():
    """Return every key that a yaml in conf/ holds, as it is typed, and the groups."""
    keys = set()

    def gather(value, prefix):
        keys.add(prefix)
        if isinstance(value, dict):
            for key, inner in value.items():
                gather(inner, f"{prefix}.{key}" if prefix else key)

    for conf, file in ((folder, file) for folder in conf_folders() for file in folder.rglob("*.yaml")):
        text = file.read_text(encoding="utf-8")
        group = file.relative_to(conf).parent.as_posix()
        base = {"scene_defaults": "scene", "camera_path_defaults": "path"}
        shared = base.get(file.stem, "") if group == "." else group
        prefix = "" if "@package _global_" in text else shared.replace("/", ".")
        gather(yaml.safe_load(text) or {}, prefix)
        if group == "what":
            gather(yaml.safe_load(text) or {}, f"final.{file.stem}")
        keys.add(group)
    return keys


def test_settings_that_are_named_are_there():
    known, unknown = known_settings(), []
    for document in DOCUMENTS:
        text = re.sub(r"```.*?```", "", document.read_text(encoding="utf-8"), flags=re.DOTALL)
        for code in re.findall(r"`([^`\n]+)`", text):
            for word in code.split():
                match = re.fullmatch(r"([a-z_/]+(?:\.[a-z_]+)*)(?:@[\w.]+)?(?:=.*)?", word)
                if match is None or ("=" not in word and "." not in word) or "/" in match[1].replace("hydra/", ""):
                    continue
                key, is_file = match[1], re.search(r"\.(py|md|json|ckpt|csv|mp4|yaml|html|png|log|npy)$", word)
                is_ours = key.split(".")[0] in {each.split(".")[0] for each in known}
                if (
                    is_ours
                    and not is_file
                    and key not in known
                    and not key.startswith(("trainer.lightning.", "hydra.searchpath"))
                ):
                    unknown.append(f"{document.name}: {word}")
    assert not unknown


def test_files_and_pages_that_are_linked_are_there():
    missing = []
    for document in [*DOCUMENTS, ROOT / "SECURITY.md"]:
        for target in re.findall(r"\]\(([^)\s#]+)\)", document.read_text(encoding="utf-8")):
            if "://" not in target and not (document.parent / target).exists():
                missing.append(f"{document.name}: {target}")
    assert not missing


def test_files_of_the_table_of_tasks_are_there():
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Where to begin")[2]
    named = re.findall(r"`((?:\w+/)+(?:\w+\.py)?)`", table.partition("\n## ")[0])
    assert len(named) > 30
    assert [name for name in named if not (ROOT / "nerf_lightning" / name).exists()] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    for needed in ("furo", "myst_nb", "sphinx_copybutton", "latex2mathml"):
        pytest.importorskip(needed)
    folder = tmp_path_factory.mktemp("site")
    # Notebooks have tests of their own.
    options = ("-q", "-W", "-b", "html", "-D", "nb_execution_mode=off")
    build = [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(folder)]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.minutes
def test_the_site_is_built_without_a_warning(site):
    method = (site / "method.html").read_text(encoding="utf-8")
    assert method.count("<math ") > 10
    assert not re.findall(r'(?:src|<link[^>]* href)="https?://[^"]*', method), "nothing is loaded from elsewhere"
    settings = (site / "settings.html").read_text(encoding="utf-8")
    assert "data.sample_budget" in settings
    assert "<math" not in settings, "a dollar in a sentence is no formula"
    assert "nerf_lightning.TrainedModel" in (site / "api.html").read_text(encoding="utf-8")


FORMULAS = """
const boxes = [...document.querySelectorAll("div.math")], faults = boxes.length ? [] : ["there are no formulas"];
const {scrollWidth, clientWidth} = document.documentElement;
if (scrollWidth > clientWidth) faults.push("the page scrolls sideways");
const wide = box => box.scrollWidth > box.clientWidth && box.children.length > 1;
const cut = box => box.scrollHeight > box.clientHeight;
return [...faults, ...boxes.filter(box => wide(box) || cut(box)).map(box => box.textContent)];
"""


WIDE_TABLES = """
return [...document.querySelectorAll("table.docutils")]
    .filter(table => table.scrollWidth > table.parentElement.clientWidth).map(table => table.textContent.slice(0, 60));
"""


@pytest.mark.minutes
def test_tables_fit_into_the_page_and_formulas_wrap_or_scroll_in_their_own_boxes(site):
    tables = ("settings", "article", "architecture", "defaults", "lego_limits", "splats", "photographs", "page")
    with opened((site / "index.html").as_uri()) as driver:
        for page in (*tables, "capture_formats", "measurements", "method", "course_2_rays"):
            driver.get((site / f"{page}.html").as_uri())
            for size in ("desktop", "phone"):
                layout_faults(driver, size)
                assert driver.execute_script(WIDE_TABLES) == [], (page, size)
            if page in ("method", "course_2_rays"):
                assert driver.execute_script(FORMULAS) == [], page


NAMES = """
const names = [...document.querySelectorAll("td code")].filter(code => /^\\S{1,36}$/.test(code.textContent));
const broken = names.filter(name => name.getClientRects().length > 1).map(name => name.textContent);
const untitled = [...document.querySelectorAll("table.wide td:first-child")].filter(title => !title.innerText.trim());
return [broken, untitled.map(title => title.parentElement.innerText)];
"""


@pytest.mark.minutes
@pytest.mark.parametrize("page", ["article", "architecture", "defaults", "lego_limits"])
def test_names_in_tables_do_not_break_and_stacked_rows_have_titles(site, page):
    with opened((site / f"{page}.html").as_uri()) as driver:
        for size in ("desktop", "phone"):
            layout_faults(driver, size)
            broken, untitled = driver.execute_script(NAMES)
            assert broken == [], size
            assert untitled == [], size


PICTURES = """
const faults = [...document.querySelectorAll("article p > img")]
    .filter(image => image.parentElement.nextElementSibling?.textContent !== image.alt).map(image => image.src);
const scrolls = box => box.scrollWidth > box.clientWidth + 1;
return [...faults, ...[...document.querySelectorAll("article pre")].filter(scrolls).map(box => box.textContent)];
"""


@pytest.mark.minutes
@pytest.mark.parametrize("page", ["export", "models", "course_1_image", "course_2_rays", "course_3_scene"])
def test_pictures_have_captions_and_code_does_not_scroll_sideways(site, page):
    with opened((site / f"{page}.html").as_uri()) as driver:
        for size in ("desktop", "phone"):
            layout_faults(driver, size)
            assert driver.execute_script(PICTURES) == [], size


def test_results_name_their_machines():
    results = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")
    machines = set(re.findall(r"\| (EPYC|Xeon \w) \|", results))
    assert machines == {"EPYC", "Xeon A", "Xeon B"}
    assert results.count("Intel") == 2  # where these are explained


SMALLER = (
    (r"resolution=\d+", "resolution=16"),
    (r"num_train=\d+", "num_train=6"),
    (r"max_steps=\d+", "max_steps=3"),
    (r"data\.crop_steps=\d+", "data.crop_steps=1"),
    (r"width=64\)", "width=8)"),
    (r"num_samples=\d+", "num_samples=8"),
    (r"\bsteps = \d+", "steps = 2"),
)
AT_THE_END = {
    "first_scene": "assert picture.rgb.shape == (16, 16, 3) and len(plt.get_fignums()) == 3, picture.rgb.shape",
    "own_field_and_loss": (
        "assert run.system.train_step.progress.step == 3 and len(pictures) == 4\n"
        "trainer.save_checkpoint('own.ckpt')\n"
        "try:\n    nl.load('own.ckpt')\n"
        "except nl.InputError as error:\n    print('refused:', error)"
    ),
    "course_1_image": "assert encoded.shape == (256, 3) and len(plt.get_fignums()) == 5, encoded.shape",
    "course_2_rays": "assert colors.shape == (96 * 96, 3) and len(plt.get_fignums()) == 7, colors.shape",
    "course_3_scene": "assert picture.rgb.shape == (16, 16, 3) and len(curve) == 2 and len(plt.get_fignums()) == 4",
}
SAID = {
    "first_scene": {"dB on test views": 1},
    "own_field_and_loss": {"dB on test views": 1, "refused: ": 1},
    "course_1_image": {"correct: ": 2},
    "course_2_rays": {"correct: ": 4},
    "course_3_scene": {"correct: ": 3, "dB on test views": 2},
}
"""What each notebook prints, and how often."""


def test_every_notebook_is_tested():
    assert {path.stem for path in (REPOSITORY / "docs").glob("*.ipynb")} == AT_THE_END.keys()


@pytest.mark.minutes
@pytest.mark.parametrize("name", AT_THE_END)
def test_a_notebook_runs_from_top_to_bottom(name, tmp_path):
    output = what_prints([*code_cells(name), AT_THE_END[name]], tmp_path)
    assert {said: output.count(said) for said in SAID[name]} == SAID[name]


@pytest.mark.minutes
@pytest.mark.parametrize("name", [name for name in SAID if "correct: " in SAID[name]])
def test_a_wrong_solution_of_an_exercise_fails_with_the_equation_to_read(name, tmp_path):
    wrong = re.findall(r"^wrong: .*", what_prints(with_wrong_solutions(code_cells(name)), tmp_path), flags=re.MULTILINE)
    assert len(wrong) == 2 * SAID[name]["correct: "]
    assert [message for message in wrong if "Look at equation" not in message] == []


def code_cells(name):
    cells = json.loads((REPOSITORY / "docs" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def what_prints(cells, folder):
    """What code cells print, with smaller sizes."""
    code = "\n\n".join(cells)
    for given, instead in SMALLER:
        code = re.sub(given, instead, code)
    return "\n".join(ran(f"{code}\n", folder))


def with_wrong_solutions(cells):
    """The cells before the last check, each run on a function without a body and on one that is slightly off, too."""
    last = max(number for number, cell in enumerate(cells) if cell.startswith("# Exercise"))
    for cell, check in itertools.pairwise(cells[: last + 2]):
        yield cell
        if cell.startswith("# Exercise"):
            (function,) = re.findall(r"^def (\w+)\(", cell, flags=re.MULTILINE)
            unsolved = re.sub(r" +# solution\n.*?# end", "", cell, flags=re.DOTALL)
            slightly_off = f"right = {function}\n{function} = lambda *given, **named: right(*given, **named) + 0.01"
            said = "print('wrong:', str(error).splitlines()[0])\nelse:\n    raise SystemExit('accepted')"
            for wrong in (unsolved, slightly_off):
                yield f"{wrong}\ntry:\n{textwrap.indent(check, '    ')}\nexcept AssertionError as error:\n    {said}"
                yield cell

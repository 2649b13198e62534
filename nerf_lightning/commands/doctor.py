"""Check a capture before training: poses, lenses, photographs, near and far, with a fix for each problem."""

import time
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from textwrap import TextWrapper, wrap
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.text import Text

from nerf_lightning.config.instantiate import build
from nerf_lightning.config.setting_rules import PLACES
from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import examine
from nerf_lightning.doctor.picture import about_capture, doctor_picture, proof_picture
from nerf_lightning.files.json_files import print_json, write_json
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.console import StdoutConsole, say, say_written, spoken
from nerf_lightning.messages.escaping import for_terminal, terminal_width
from nerf_lightning.runs.command_folder import output_folder
from nerf_lightning.visualization.pictures import save_png

STYLES = {"ok": "green", "look": "yellow", "wrong": "bold red", "not judged": "dim"}
UNWRAPPED = 10_000  # Columns without a terminal: lines are not wrapped, so that they can be searched.


def run(config: DictConfig) -> int:
    """Run the checks and return how many have the verdict `wrong`."""
    started = time.monotonic()
    reader = build(config.scene)
    scene = reader.read()
    about = about_capture(scene, *_origin(config, reader))
    default = child_of(Path(config.paths.root_dir), scene.name, f"doctor_{datetime.now():%Y-%m-%d_%H-%M-%S}")
    folder = output_folder(config.paths.output_dir, default)
    analysis, checks = examine(scene)
    rows = [{key: getattr(check, key) for key in ("name", "verdict", "message", "cure")} for check in checks]
    result = {"scene": scene.name, "capture": about, "checks": rows}
    write_json(folder / "doctor.json", result)
    save_png(folder / "doctor.png", doctor_picture(analysis, checks, about))
    written = [folder / "doctor.json", folder / "doctor.png"]
    proofs = [proof for check in checks for proof in check.proofs]
    if proofs:
        written.append(folder / "doctor_proof.png")
        save_png(written[-1], proof_picture(scene, proofs))
    wrongs = sum(check.verdict == "wrong" for check in checks)
    if config.json:
        print_json(result | {"written": written})
        return wrongs
    say(*wrap(f"capture  {about}", terminal_width(UNWRAPPED), subsequent_indent=" " * 9))
    print_checks(checks)
    seconds = time.monotonic() - started
    say(f"{summary(checks)}; {len(scene.view_names)} views examined in {spoken(seconds)}")
    say_written(*written)
    return wrongs


def _origin(config: DictConfig, reader: Any) -> tuple[str | None, str]:
    """Return the capture's path, and the name of its format for scene=."""
    form = HydraConfig.get().runtime.choices["scene"]
    if isinstance(reader, AutoReader):
        known = reader.known_format(reader.folder())
        form = form if known is None else known.scene
    given = (config.scene.get(key.partition(".")[2]) for key in PLACES)
    return next((str(place) for place in given if place), None), str(form)


def summary(checks: Sequence[Check]) -> str:
    """Return one line.

    >>> summary([Check("lens", "ok", "none"), Check("blur", "look", "2 of 50", "Remove them.")])
    '1 ok, 0 not judged, 1 to look at, 0 wrong'
    """
    counts = Counter(check.verdict for check in checks)
    judged = f"{counts['look']} to look at, {counts['wrong']} wrong"
    return f"{counts['ok']} ok, {counts['not judged']} not judged, {judged}"


def print_checks(checks: Sequence[Check]) -> None:
    """Print a line per check; the cure of a problem is below it."""
    console = StdoutConsole(highlight=False, soft_wrap=True)
    width = max(len(check.name) for check in checks)
    lines = TextWrapper(terminal_width(UNWRAPPED), subsequent_indent=" " * (width + 14), break_long_words=False)
    for check in checks:
        found = Text(lines.fill(f"{check.verdict:<10}  {check.name:<{width}}  {for_terminal(check.message)}"))
        found.stylize(STYLES[check.verdict], 0, len(check.verdict))
        console.print(found)
        if check.cure:
            label = "needs" if check.verdict == "not judged" else "cure"
            console.print(Text(lines.fill(f"{'':<{width + 14}}{label}: {for_terminal(check.cure)}")))

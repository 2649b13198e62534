"""The original arguments of a sweep, kept in its folder and read when it is resumed."""

from dataclasses import dataclass
from pathlib import Path

import yaml

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.files.regular import AbsentError
from nerf_lightning.files.yaml_files import CURE, read_plain_yaml
from nerf_lightning.messages.errors import InputError

MADE = ("hydra.mode=", "hydra.sweep.", "sweep.")
"""Arguments that were derived, or that belong to one start: they are derived again."""


@dataclass(frozen=True)
class SweepRecord:
    """The original arguments of a sweep, from its untrusted folder."""

    arguments: list[str]
    slurm_job: str | None = None

    def write(self, sweep_folder: Path) -> None:
        """Write it to the sweep's folder."""
        record = sweep_record(sweep_folder)
        make_folder(sweep_folder, record.parent.name)
        with whole_file(record) as part:
            part.write_text(yaml.safe_dump({"arguments": self.arguments, "slurm_job": self.slurm_job}))

    def typed(self) -> list[str]:
        """Return the arguments without derived ones."""
        return [argument for argument in self.arguments if not argument.startswith(MADE)]


def sweep_record(sweep_folder: Path) -> Path:
    """Return the file with the original arguments of a sweep."""
    return sweep_folder / ".hydra" / "sweep.yaml"


def read_sweep(sweep_folder: Path) -> SweepRecord | None:
    """Return the record of a sweep; None if the folder contains no sweep."""
    record = sweep_record(sweep_folder)
    try:
        content = read_plain_yaml(record)
    except AbsentError:
        return None
    arguments = content.get("arguments") if isinstance(content, dict) else None
    if not isinstance(arguments, list) or not all(isinstance(argument, str) for argument in arguments):
        raise InputError(f"{record} is not a record of a sweep. {CURE}")
    job = content.get("slurm_job")
    return SweepRecord(arguments, job if isinstance(job, str) else None)

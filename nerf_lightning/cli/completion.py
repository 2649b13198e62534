"""`nerf completion bash`: the script with which a shell completes what is typed after `nerf`.

Hydra has such scripts, too. They compose the config at each press of the key, which takes seconds, and know neither
our commands nor what a setting takes.
"""

from pathlib import Path

from nerf_lightning.config.manual.candidates import SHELLS, candidates
from nerf_lightning.config.manual.suggestions import did_you_mean
from nerf_lightning.messages.errors import InputError

SCRIPTS = Path(__file__).parent / "completions"
CANDIDATES = "candidates"
"""What the scripts ask for, with the words that have been typed."""


def completion(arguments: list[str], commands: list[str]) -> str:
    """Return the script of a shell; or, as the scripts ask for it, what the last of some words may become.

    Raises:
        InputError: no shell is named, or one that has no script.
    """
    if arguments[:1] == [CANDIDATES]:
        return "\n".join(candidates(arguments[1:], commands))
    shell = arguments[0] if arguments else ""
    if shell not in SHELLS:
        told = f"There is no completion for '{shell}'." if shell else "Completion of which shell?"
        raise InputError(f"{told}{did_you_mean(shell, SHELLS)} nerf completion bash, zsh or fish prints its script.")
    return (SCRIPTS / f"nerf.{shell}").read_text(encoding="utf-8").rstrip()

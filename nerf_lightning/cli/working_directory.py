"""What lies in the working directory is data: nothing of it is imported, and no library takes its settings from there.

`nerf` may be called in a folder that somebody else made. Python looks for modules there first when it is started with
`-m` or `-c`, as launchers, pools of processes and compilers start it.
"""

import os
import sys

from nerf_lightning.messages.errors import InputError

SETTINGS = {
    ".numba_config.yaml": "numba, whose settings can be given as variables (NUMBA_...)",
    "matplotlibrc": "matplotlib, which also reads ~/.config/matplotlib/matplotlibrc",
}
"""Files that libraries look for in the working directory, and no variable of theirs keeps them from it."""


def keep_from_subprocesses() -> None:
    """Let the Python processes that this one starts, directly or through libraries, import nothing from there."""
    os.environ["PYTHONSAFEPATH"] = "1"
    # A clone that is not installed was found there itself.
    clone = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    if clone not in sys.path:
        sys.path.append(clone)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), clone]))


def require_no_settings_here() -> None:
    """Refuse to start where a library would obey a file of the working directory.

    Raises:
        InputError: with its name.
    """
    for name, library in SETTINGS.items():
        if os.path.lexists(name):
            raise InputError(
                f"The working directory has a file {name}, which would be obeyed by {library}; with it, whoever made "
                "this folder could change what is computed, or have programs run. Rename the file, or start nerf in "
                "another folder."
            )

"""`python -m nerf_lightning` is `nerf`."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the working directory, which `python -m` puts there

from nerf_lightning.cli.process import main

main()

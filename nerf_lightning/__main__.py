"""`python -m nerf_lightning` is `nerf`."""

from nerf_lightning.cli.process import main

main()

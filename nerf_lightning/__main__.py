"""`python -m nerf_lightning` is `nerf`."""

from nerf_lightning.cli.main import main

main()

"""The panel's section for the output of `nerf export`: each file can be downloaded."""

from pathlib import Path
from typing import Any

from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.runs.file_steps import exported_files

MOST_BYTES = 1 << 28  # A larger file would fill the memory of browser and viewer.
MOST_LETTERS = 60


class ExportPanel:
    """Let one user download what is in the folder of exports when they connect."""

    def __init__(self, session: ViewerClient, folder: Path):
        # Links may lead anywhere.
        files = [each for each in exported_files(folder) if not each.name.startswith(".") and not each.is_symlink()]
        self.session = session
        if not files:
            return
        gui, harmless = session.client.gui, session.queue.errors.harmless
        with gui.add_folder("Exports", expand_by_default=False):
            for file in files:
                label = f"{for_terminal(file.name, MOST_LETTERS)} ({file.stat().st_size / 1e6:.2g} MB)"
                button = gui.add_button(label, hint="Download")
                button.on_click(harmless(self._sender(file)))

    def _sender(self, file: Path) -> Any:
        return lambda _: self.session.client.send_file_download(file.name, read_bytes(file, MOST_BYTES))

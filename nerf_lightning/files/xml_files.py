"""XML files: plain elements, without entities, a few lines of which can expand to billions of characters."""

from pathlib import Path
from xml.etree import ElementTree

from nerf_lightning.files.regular import read_text
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError


def read_xml(path: Path, cure: str) -> ElementTree.Element:
    """Return the root of an XML file."""
    text = read_text(path, "xml", cure)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} declares XML entities, which are not read. {cure}")
    with reading(path, cure):
        return ElementTree.fromstring(text)

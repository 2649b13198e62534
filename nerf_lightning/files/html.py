"""Self-contained pages: opened from disk, they load nothing, and run only our own scripts."""

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_html

SCENE_PAGE = b"<!-- nerf_lightning page 1 -->"
"""The beginning of a scene's page (`nerf export what=page`)."""


def rendered(template: Path, **values: Any) -> str:
    """Return a page; every text in it is escaped, and only `Markup` is inserted unchanged."""
    environment = Environment(
        loader=FileSystemLoader(template.parent), autoescape=True, undefined=StrictUndefined, finalize=_escaped
    )
    return environment.get_template(template.name).render(**values)


def write_page(template: Path, target: Path, **values: Any) -> None:
    """Write a page as one file, with the script and the style of the same name next to the template."""
    script, style = (template.with_suffix(ending).read_text(encoding="utf-8") for ending in (".js", ".css"))
    policy = own_policy(script, style)
    # Only ours are inserted unchanged.
    page = rendered(template, **values, policy=policy, script=Markup(script), style=Markup(style))
    with whole_file(target) as part:
        part.write_text(page, encoding="utf-8")


def is_scene_page(path: Path) -> bool:
    """Return whether a file begins like our page of a scene."""
    try:
        with open_regular(path, None) as file:
            return SCENE_PAGE in file.read(200)
    except InputError:
        return False


def own_policy(script: str, style: str) -> str:
    """Return the content security policy of a page with one script, one style, and embedded pictures and films."""
    return (
        f"default-src 'none'; img-src data:; media-src data:; script-src '{_digest(script)}'; "
        f"style-src '{_digest(style)}'; base-uri 'none'; form-action 'none'"
    )


def json_in_page(value: Any) -> Markup:
    """Return a value as JSON for an element of a page; nothing in it closes the element."""
    text = json.dumps(value, allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def data_address(kind: str, content: bytes) -> str:
    """Return bytes as a data URL of a media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _escaped(value: object) -> object:
    return Markup(for_html(value)) if type(value) is str else value


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"

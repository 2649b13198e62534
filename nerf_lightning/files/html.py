"""Pages that hold all that they show: opened from the disk, they load nothing, and run no script but our own."""

import base64
import hashlib
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.escaping import for_html


def rendered(template: Path, **values: Any) -> str:
    """Return a page; every text in it is escaped, and only `Markup` is put in as it is."""
    environment = Environment(
        loader=FileSystemLoader(template.parent), autoescape=True, undefined=StrictUndefined, finalize=_escaped
    )
    return environment.get_template(template.name).render(**values)


def write_page(template: Path, target: Path, **values: Any) -> None:
    """Write a page as one file, with the script and the style of its name beside the template."""
    script, style = (template.with_suffix(ending).read_text(encoding="utf-8") for ending in (".js", ".css"))
    policy = own_policy(script, style)
    # Ours alone are put in as they are.
    page = rendered(template, **values, policy=policy, script=Markup(script), style=Markup(style))
    with whole_file(target) as part:
        part.write_text(page, encoding="utf-8")


def own_policy(script: str, style: str) -> str:
    """Return the content security policy of a page with one script and one style, and pictures and films within it."""
    return (
        f"default-src 'none'; img-src data:; media-src data:; script-src '{_digest(script)}'; "
        f"style-src '{_digest(style)}'; base-uri 'none'; form-action 'none'"
    )


def data_address(kind: str, content: bytes) -> str:
    """Return bytes as an address of this media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _escaped(value: object) -> object:
    return Markup(for_html(value)) if type(value) is str else value


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"

"""How Sphinx builds these documents: make docs."""

import re
import sys
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import settings_page  # noqa: E402
import site_pages  # noqa: E402

project = html_title = "nerf_lightning"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
# Formulas are MathML, which browsers show without a network.
html_math_renderer = "mathml"
html_theme = "furo"
html_show_copyright = False
html_extra_path = ["llms.txt"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = [("site.js", {"defer": "defer"})]
exclude_patterns = ["_build", "jupyter_execute", "README.md"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
# Links to source files, which the site does not have; tests/test_documents.py checks that they exist.
suppress_warnings = ["myst.xref_missing"]
# Notebooks are kept without outputs. They run when the site is built, and again only once their cells have changed, or
# after make clean.
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / ".jupyter_cache")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
maximum_signature_line_length = 100
# Docstrings write `code` as Markdown does.
default_role = "code"

settings_page.write(HERE)
site_pages.write()


BOLD = re.compile(r'<mi mathvariant="bold">([A-Za-z])</mi>')
HAT = re.compile(r'<mover accent="true">(?:<mrow>)?<mi( mathvariant="bold")?>C</mi>(?:</mrow>)?<mo>&#x0005E;</mo></mover>')
BRACKET = re.compile('<mo stretchy="[^>]*>')


def mathml(formula, display="inline"):
    """Return a formula as MathML; browsers know bold letters only as letters of their own (U+1D400 and so on).

    Brackets keep their size, and bars stand at what they enclose: without a font for mathematics, stretched ones sink.
    """

    def bold(letter):
        first, offset = (0x1D400, ord("A")) if letter[1].isupper() else (0x1D41A, ord("a"))
        return f"<mi>{chr(first + ord(letter[1]) - offset)}</mi>"

    def hat(mover):  # one letter with its hat, which stands where it should
        return f'<mi style="font-{"weight: bold" if mover[1] else "style: italic"}">\u0108</mi>'

    converted = BRACKET.sub('<mo stretchy="false" lspace="0" rspace="0">', convert(formula, display=display))
    return BOLD.sub(bold, HAT.sub(hat, converted))


def inline_math(page, node):
    """Write a formula in a line of text."""
    page.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def display_math(page, node):
    """Write a formula on a line of its own, or on several where its equations do not fit next to each other."""
    equations = re.split(r"\\q?quad\b", node.astext())
    page.body.append(f'<div class="math">{"".join(mathml(equation, "block") for equation in equations)}</div>')
    raise nodes.SkipNode


def setup(app):
    """Make links between documents links within the site, and formulas MathML."""
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
    app.connect("source-read", lambda app, page, text: text.__setitem__(0, site_pages.within_site(text[0], HERE)))

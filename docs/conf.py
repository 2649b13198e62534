"""How Sphinx builds these documents: make docs."""

project = "nerf_lightning"
extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "nerf_lightning"
html_show_copyright = False
exclude_patterns = ["_build"]
# Files of the repository outside of docs are shown as links, and checked by tests/test_documents.py.
suppress_warnings = ["myst.xref_missing"]

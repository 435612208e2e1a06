"""The documentation site, built by `make docs`. Nothing is fetched, neither when it is built nor when it is read."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import magnetosuture_thread

sys.path.insert(0, str(Path(__file__).parent))  # for our own extensions


def mathjax_script() -> str:
    """Return the path of MathJax's one file that draws formulas without fonts of its own."""
    found = find_spec("sphinx-mathjax-offline")
    assert found is not None
    assert found.submodule_search_locations is not None
    return str(Path(found.submodule_search_locations[0]) / "static/mathjax/tex-svg.js")


project = "magnetosuture_thread"
release = version = magnetosuture_thread.__version__
author = "magnetosuture_thread maintainers"
copyright = author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "generated_reference",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
smartquotes = False  # `--option` stays what it is
highlight_language = "bash"  # of indented blocks, which hold commands

# Markdown as GitHub reads it: its anchors, its formulas.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
add_module_names = False
autodoc_typehints = "none"  # the signature names the types in words that docstrings explain
default_role = "literal"  # `name` in docstrings is code
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"magnetosuture_thread {version}"
html_static_path = ["_static", mathjax_script()]
html_css_files = ["site.css"]
html_show_sphinx = html_copy_source = False
mathjax_path = "tex-svg.js"
html_theme_options = {
    "announcement": "Research software, no medical device. All data here is simulated.",
}

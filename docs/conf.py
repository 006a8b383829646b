"""How the documentation is built: `make docs`."""

import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from pygments.lexers.shell import BashLexer

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

project = "calib"
author = "The calib contributors"
copyright = "the calib contributors, MIT licence"  # noqa: A001
try:
    release = metadata.version("terracalib")
except metadata.PackageNotFoundError:  # a checkout that is not installed
    release = ""

extensions = [
    "myst_nb", "kernels", "mathml", "declared", "sphinx.ext.autodoc", "sphinx.ext.napoleon",
]  # fmt: skip
autodoc_typehints = "none"
autodoc_preserve_defaults = True
napoleon_use_param = False
napoleon_use_rtype = False
exclude_patterns = ["_ext", "joss"]  # a paper, built by its journal
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_block"]
myst_heading_anchors = 3
# Notebooks, and no other pages, are run at every build: their outputs are those of this code.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # seconds, for each cell
nb_output_stderr = "warn"
html_math_renderer = "mathml"
html_theme = "furo"
html_title = "calib"
html_static_path = ["_static", "../calib/report/page/page.js"]
html_css_files = ["tables.css", "notebooks.css"]
html_js_files = [("page.js", {"defer": ""})]  # tables sort as those of a report do
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
# What the pages show is what they were made from, not when.
html_last_updated_fmt = None
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"
nitpicky = True


def setup(app: Any) -> None:
    """Draw commands as commands: without a prompt they would be taken for output."""
    app.add_lexer("console", BashLexer)
    # After the theme, which puts the navigation there.
    app.connect("html-page-context", say_levels, priority=900)


def say_levels(app: Any, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Give the captions of contents the level without which a reader of screens is lost."""
    for part in ("body", "furo_navigation_tree"):
        if part in context:
            context[part] = context[part].replace('role="heading"', 'role="heading" aria-level="2"')

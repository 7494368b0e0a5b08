"""The site of docs/: `sphinx-build --fail-on-warning docs build/site`."""

import re
import tomllib
from pathlib import Path

from experts import arguments

ROOT = Path(__file__).parents[1]

project = "mapf-env"
author = "The mapf-env authors"
version = release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

default_role = "code"
exclude_patterns = ["paper"]  # what benchmarks/paper.py draws, included by other pages
highlight_language = "none"  # of blocks that name no language
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
myst_heading_anchors = 3
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True  # as written, so without the paths of the machine that builds
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_type_aliases = {"npt.ArrayLike": "ArrayLike"}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "mapf-env"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False


def setup(app):
    """Defaults as numbers; and keep napoleon from reading the words before an attribute's first colon as its type."""

    def numbers(app, what, name, subject, options, signature, returned):
        if signature:
            shown = re.sub(r"arguments\.(DEFAULT_\w+)", lambda name: repr(getattr(arguments, name[1])), signature)
            return shown, returned
        return None

    def comma(app, what, name, subject, options, lines):
        if what in ("attribute", "property", "data") and lines:
            lines[0] = lines[0].replace(": ", ", ", 1)

    app.connect("autodoc-process-signature", numbers)
    app.connect("autodoc-process-docstring", comma, priority=400)

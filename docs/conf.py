"""The site of docs/: `pip install -e ".[docs]"`, then `sphinx-build --fail-on-warning docs build/site`."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive

try:
    import gnn_policy  # noqa: F401
    from experts import arguments
except ImportError as missing:
    raise SystemExit(
        f'the site shows docstrings, so it needs the package: pip install -e ".[docs]" ({missing})'
    ) from None

ROOT = Path(__file__).parents[1]

project = "mapf-env"
author = "The mapf-env authors"
version = release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

default_role = "code"
exclude_patterns = ["paper"]  # what benchmarks/paper.py draws, included by other pages
highlight_language = "none"  # of blocks that name no language
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_design"]
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist"]
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


class Options(Directive):
    """Show what `python -m MODULE ... --help` prints, so that the page of commands is never out of date."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self):
        """Run the command."""
        command = [sys.executable, "-m", *self.arguments[0].split(), "--help"]
        environment = {**os.environ, "COLUMNS": "88", "NO_COLOR": "1", "TERM": "dumb", "PYTHONIOENCODING": "utf-8"}
        done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, encoding="utf-8", check=True)
        return [nodes.literal_block(done.stdout, done.stdout, language="none")]


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

    app.add_directive("options", Options)
    app.connect("autodoc-process-signature", numbers)
    app.connect("autodoc-process-docstring", comma, priority=400)

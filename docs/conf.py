"""The documentation site: `make docs`, or `python -m sphinx -W --keep-going -b html docs docs/_build/html`."""

import re
import sys
from pathlib import Path
from typing import Any

from sb3_have import __version__

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "sb3_have"
author = "sb3_have contributors"
project_copyright = author
release = version = __version__

# MathJax is part of the site, so that formulas need no network. "results" is in _ext.
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx.ext.viewcode",
    "results",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "sb3_have"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["sort_tables.js"]
html_copy_source = False
smartquotes_action = "D"  # dashes alone: what docstrings quote is code to copy

# Anchors for links to headings, as GitHub makes them; ::: fences and LaTeX between dollars
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence", "dollarmath"]

# Types stand in the signatures' place, beside the :param: lines that SB3's style has
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_inherit_docstrings = False

# Pages link to what lies outside of docs as it lies, so that they read well on their own. Some of that is a page here,
# by inclusion; what else the included texts link to is only named.
RECORDS = {
    "../benchmarks/STUDY.md": "records/study.md",
    "../benchmarks/results/study_quick/faults.md": "records/faults.md",
    "results/reliability/design.md": "design.md",
}
LOCAL_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:|#)([^)]+)\)")


def link_records(app: Any, page: str, source: list[str]) -> None:
    for file, record in RECORDS.items():
        source[0] = source[0].replace(f"]({file})", f"]({record})")


def link_within_records(app: Any, path: Any, page: str, source: list[str]) -> None:
    source[0] = LOCAL_LINK.sub(
        lambda link: f"[{link[1]}]({RECORDS[link[2]]})" if link[2] in RECORDS else link[1], source[0]
    )


def setup(app: Any) -> None:
    app.connect("source-read", link_records)
    app.connect("include-read", link_within_records)

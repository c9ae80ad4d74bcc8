"""The documentation site: `make docs`, or `python -m sphinx -W --keep-going -b html docs docs/_build/html`."""

from typing import Any

from sb3_have import __version__

project = "sb3_have"
author = "sb3_have contributors"
project_copyright = author
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "sb3_have"
html_copy_source = False

# Anchors for links to headings, as GitHub makes them; ::: fences and LaTeX between dollars
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence", "dollarmath"]

# Types stand in the signatures' place, beside the :param: lines that SB3's style has
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_inherit_docstrings = False

# What lies outside of docs is linked as it lies, so that the pages read well on their own, and is a page here
RECORDS = {
    "../benchmarks/STUDY.md": "records/study.md",
    "../benchmarks/results/study_quick/faults.md": "records/faults.md",
    "results/reliability/design.md": "design.md",
}


def to_records(text: str) -> str:
    for file, page in RECORDS.items():
        text = text.replace(f"]({file})", f"]({page})")
    return text


def setup(app: Any) -> None:
    app.connect("source-read", lambda app, page, source: source.insert(0, to_records(source.pop())))
    app.connect("include-read", lambda app, path, page, source: source.insert(0, to_records(source.pop())))

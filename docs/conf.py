"""Sphinx: the site of the documents, built by `make docs` from build/docs/source."""

project = "motorhil"
author = "motorhil"
extensions = ["myst_parser"]
root_doc = "index"
exclude_patterns = ["requirements.lock"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "motorhil"
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False

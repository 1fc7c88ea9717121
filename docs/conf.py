"""Sphinx: `make docs` builds the pages into docs/_build/html, and takes warnings for errors."""

import sb3_aarl

project = "sb3-aarl"
author = "the sb3-aarl developers"
version = release = sb3_aarl.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
html_theme = "furo"
html_title = f"sb3-aarl {release}"
html_show_copyright = False
exclude_patterns = ["_build"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
# The types stand beside each parameter's text; a signature shows names and defaults, one a line where they are many.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["ray"]
maximum_signature_line_length = 100
add_module_names = False

"""Sphinx: `make docs` builds the pages into docs/_build/html, and takes warnings for errors."""

import json
from pathlib import Path

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


def notebook(app, docname, source):
    """The page guides/notebook is the notebook of examples/ with its outputs."""
    if docname != "guides/notebook":
        return
    path = Path(__file__).parent.parent / "examples" / "from_sac_to_sac_aux.ipynb"
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text.replace("../docs/guides/", "") if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text")})
            png = "".join(data.get("image/png", ())).replace("\n", "")
            shown = f'<img src="data:image/png;base64,{png}" alt="">' if png else "".join(data["text/plain"]).rstrip()
            parts.append(shown if png else f"```text\n{shown}\n```")
    source[0] = "\n\n".join(parts)


def setup(app):
    app.connect("source-read", notebook)

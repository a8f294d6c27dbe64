"""Sphinx: the documentation as a site; `make docs` builds it."""

import wavequake

project = "Wavequake"
author = "The Wavequake developers"
release = version = wavequake.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_site"]
html_theme = "furo"
html_title = "Wavequake"
html_theme_options = {"navigation_with_keys": True}
# Reports of the gallery stand beside the pages.
html_extra_path = ["_site/extra"]
myst_heading_anchors = 4
napoleon_numpy_docstring = True
napoleon_use_rtype = False
autodoc_typehints = "none"
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True
suppress_warnings = ["myst.xref_missing", "misc.highlighting_failure"]
html_show_copyright = False

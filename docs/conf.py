"""Sphinx configuration: `python -m sphinx -W -b html docs docs/_build/html`. Nothing here needs the network."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_build_tools"))

import fieldcal

project = "fieldcal"
version = release = fieldcal.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_parser",
    "generated_pages",
    "house_docstrings",
    "offline_math",
]
exclude_patterns = ["_build", "_build_tools"]
suppress_warnings = ["ref.python"]  # a public name has two places: fieldcal.X, and the module that defines it
default_role = "literal"  # docstrings write `name` for code

myst_enable_extensions = ["amsmath", "dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
myst_dmath_double_inline = False

math_eqref_format = "({number})"
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
python_use_unqualified_type_names = True
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"fieldcal {version}"
html_show_sourcelink = False
html_copy_source = False
html_show_copyright = False

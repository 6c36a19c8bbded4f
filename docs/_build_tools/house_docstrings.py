"""The house's docstrings as reStructuredText: an indented block after a blank line is a display as it stands, and the
signs that mean something in reStructuredText (`|x|`, `rot_`, `2 * 3`) mean themselves."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

KEPT = re.compile(r"(`+[^`]+`+|\*\*[^*]+\*\*|(?<![\w*-])\*\w(?:[^*]*\w)?\*(?![\w*]))")  # code, **bold**, *emphasis*
UNDERLINE = re.compile(r"^\s*(-{3,}|={3,})\s*$")


def plain(text: str) -> str:
    """One line with the signs of markup escaped outside of code, **bold** and *emphasis*."""
    parts = KEPT.split(text)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", parts[i])
        parts[i] = parts[i].replace("*", r"\*").replace("|", r"\|")
    return "".join(parts)


def indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def as_restructured_text(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrites `lines`: paragraphs escaped, displays made literal blocks, doctests left alone."""
    out: list[str] = []
    base, display = 0, False
    for i, line in enumerate(lines):
        if not line.strip():
            out.append("")
            continue
        before_blank = i > 0 and not lines[i - 1].strip()
        if display and indent(line) <= base:
            display = False
        if not display and before_blank and out and indent(line) > base and not line.lstrip().startswith(("- ", ">>>")):
            out += [" " * base + "::", ""]
            display = True
        if not display:
            base = indent(line)
        doctest = line.lstrip().startswith((">>>", "..."))
        out.append(line if display or doctest or UNDERLINE.match(line) else plain(line))
    lines[:] = out


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", as_restructured_text, priority=400)  # before napoleon's
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""The meaning of a statement as text: its syntax tree without positions, comments, docstrings and formatting."""

from __future__ import annotations

import ast


def meaning(node: ast.AST, *, annotations_are_late: bool) -> str:
    """A text that differs where the statement does, not where only its layout or its words to the reader do.

    Parameters
    ----------
    node : ast.AST
        The statement.
    annotations_are_late : bool
        Whether the module has `from __future__ import annotations`: then those of parameters, results and variables
        have no effect and are left out; those of classes make the fields of a dataclass and stay.
    """
    out: list[str] = []
    _write(node, out, late=annotations_are_late, in_class=False)
    return "".join(out)


def is_silent(node: object) -> bool:
    """Whether a statement does nothing: a docstring, another string or number that stands alone, `pass`."""
    return isinstance(node, ast.Pass) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))


def _write(value: object, out: list[str], *, late: bool, in_class: bool) -> None:
    if late and not in_class and isinstance(value, ast.AnnAssign) and value.value is not None:
        value = ast.Assign(targets=[value.target], value=value.value)
    if isinstance(value, ast.AST):
        functions = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
        within = isinstance(value, ast.ClassDef) or (in_class and not isinstance(value, functions))
        out.append(f"{type(value).__name__}(")
        for name in value._fields:
            if late and _is_late(value, name, in_class=in_class):
                continue
            if name not in ("type_comment", "kind", "ctx"):
                out.append(f"{name}=")
                _write(getattr(value, name, None), out, late=late, in_class=within)
        out.append(")")
    elif isinstance(value, list):
        out.append("[")
        for item in value:
            if not is_silent(item):
                _write(item, out, late=late, in_class=in_class)
        out.append("]")
    else:
        out.append(f"{type(value).__name__}:{value!r},")


def _is_late(node: ast.AST, name: str, *, in_class: bool) -> bool:
    """Whether a part of a node is an annotation that is never evaluated."""
    if isinstance(node, ast.AnnAssign):
        return name == "annotation" and not in_class
    return (isinstance(node, ast.arg) and name == "annotation") or name == "returns"

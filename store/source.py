"""The source of functions and classes as text without comments, docstrings and blank lines."""

from __future__ import annotations

import ast
import dis
import hashlib
import inspect
import io
import linecache
import platform
import sys
import textwrap
import tokenize
import types
from collections.abc import Iterator
from typing import Any


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """The code of a function and of the functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def names_in(code: types.CodeType) -> set[str]:
    """The names that a function and the functions inside it use."""
    return {name for each in _codes(code) for name in each.co_names}


def imports_in(code: types.CodeType) -> set[str]:
    """The modules that a function imports when it is called."""
    instructions = (each for inner in _codes(code) for each in dis.get_instructions(inner))
    return {each.argval for each in instructions if each.opname == "IMPORT_NAME"}


def source_of(value: types.FunctionType | type) -> str:
    """The source of a function or a class without comments, docstrings and blank lines; empty if there is none."""
    try:
        if value.__name__ == "<lambda>":
            return _lambda_source(value)
        # If a decorator made the function, `__code__` gives the source of the wrapper; the function itself would give
        # the source of the decorated function.
        return _bare(textwrap.dedent(inspect.getsource(getattr(value, "__code__", value))))
    except (OSError, TypeError, SyntaxError, IndentationError, tokenize.TokenError):
        return ""


def _lambda_source(function: Any) -> str:
    """The source of the lambda `function`, or of all lambdas that start in its line if none of them matches."""
    code = function.__code__
    text = "".join(linecache.getlines(code.co_filename, function.__globals__))
    nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Lambda)]
    nodes = [node for node in nodes if node.lineno == code.co_firstlineno]
    segments = {ast.get_source_segment(text, node) or "": node for node in nodes}
    # The code of a lambda inside a lambda matches both. The shorter source is the right one.
    alike = sorted((segment for segment, node in segments.items() if _is_source_of(segment, node, code)), key=len)
    return "\n".join(" ".join(segment.split()) for segment in alike[:1] or segments)


def _is_source_of(segment: str, node: ast.Lambda, code: types.CodeType) -> bool:
    if sys.version_info >= (3, 11):
        body, places = node.body, [place for place in code.co_positions() if place[3]]
        first, last = (body.lineno, body.col_offset), (body.end_lineno, body.end_col_offset)
        inside = [first <= (place[0], place[2]) and (place[1], place[3]) <= last for place in places]
        return bool(places) and all(inside)
    variables = ", ".join(code.co_freevars)  # variables of the function around it
    inner = list(_codes(compile(f"def _({variables}): return ({segment})", "", "exec")))[2]
    parts = ("co_code", "co_names", "co_varnames", "co_freevars", "co_consts")
    return all(getattr(inner, part) == getattr(code, part) for part in parts)


def _bare(source: str) -> str:
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(node) is not None:
            text = node.body[0]
            if text.lineno > node.lineno and len(node.body) > 1 and node.body[1].lineno > (text.end_lineno or 0):
                lines[text.lineno - 1 : text.end_lineno] = [""] * len(lines[text.lineno - 1 : text.end_lineno])
    return "\n".join(line.rstrip() for line in lines if line.strip())


def without_source(code: types.CodeType) -> str:
    """Describe a function without a source, such as one typed at a prompt, by its constants, names and bytecode."""
    constants = [without_source(c) if isinstance(c, types.CodeType) else _constant(c) for c in code.co_consts]
    said = f"without a source; constants {', '.join(constants)}; names {', '.join(sorted(code.co_names))}"
    version = ".".join(platform.python_version_tuple()[:2])
    return f"{said}; checksum {hashlib.sha256(code.co_code).hexdigest()[:12]} under Python {version}"


def _constant(value: Any) -> str:
    return f"frozenset {sorted(map(repr, value))}" if isinstance(value, frozenset) else repr(value)

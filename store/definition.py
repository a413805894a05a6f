"""What a run is trained on, as text: the task's constraint and robot, and the algorithm, with their parameters.

Names of tasks and algorithms do not tell what they stand for: a user's own can change between two runs. A description
maps paths, such as `constraint.bound`, to text that is the same in every process and Python version: values, and the
source of functions and of the user's classes. The project's own classes are described by their name, as the commit in
info.json stands for their code. `differences` says what has changed between two descriptions.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import io
import linecache
import re
import sys
import textwrap
import tokenize
import types
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np

from store.origin import is_project, is_user, module_of, user_file

Description = dict[str, str]

_USER = "user code"
"""The key that a description has if something of it is the user's code."""
_SHOWN = 3
"""The most differences that a message lists."""
_PRINTED = 16
"""The most numbers of an array that are written out; of larger ones, the checksum is."""
_WIDTH = 70
_PLAIN = (type(None), bool, int, float, complex, str, bytes, Enum, PurePath, re.Pattern, range)
_FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial, types.BuiltinFunctionType, staticmethod)
_FUNCTIONS += (classmethod, property)  # type: ignore[assignment]


def describe(parts: Mapping[str, Any]) -> Description:
    """The description of named objects: constraints, classes, functions, numbers, tensors, or what holds such."""
    describer = _Describer()
    for name, value in parts.items():
        describer.add(name, value)
    return describer.found


def is_own(description: Mapping[str, str]) -> bool:
    """Whether nothing described is the user's code."""
    return _USER not in description


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """What differs between two descriptions, in one line; empty if nothing does."""
    changed = [key for key in {**before, **now} if before.get(key) != now.get(key) and key != _USER]
    # A value tells more than the source around it, and the outermost thing more than what is in it.
    changed.sort(key=lambda key: ("\n" in before.get(key, "") + now.get(key, ""), key.startswith("class ")))
    kept: list[str] = []
    for key in changed:
        if not any(key.startswith((f"{outer}.", f"{outer}[")) for outer in kept):
            kept.append(key)
    said = []
    for key in kept[:_SHOWN]:
        then, present = _first_difference(before.get(key), now.get(key))
        said.append(f"{_in_words(key)}: {_shorten(then)} then, {_shorten(present)} now")
    if len(kept) > _SHOWN:
        said.append(f"and {len(kept) - _SHOWN} more")
    return "; ".join(said)


def _in_words(key: str) -> str:
    owner, dot, rest = key.partition(".")
    if owner.startswith("class "):
        return f"{rest} in {owner}" if dot else f"the source of {owner}"
    return f"the {owner}'s {rest}" if dot else f"the {owner}"


def _first_difference(before: str | None, now: str | None) -> tuple[str | None, str | None]:
    """The values of one key; of sources, the first lines that differ."""
    if before is None or now is None or "\n" not in before + now:
        return before, now
    lines = zip([*before.splitlines(), ""], [*now.splitlines(), ""], strict=False)
    return next((pair for pair in lines if pair[0] != pair[1]), (before, now))


def _shorten(text: str | None) -> str:
    if text is None:
        return "none"
    line = " ".join(text.split())
    return line if len(line) <= _WIDTH else line[: _WIDTH - 1] + "…"


class _Describer:
    """Collects the description. Each object is described once; later paths name the first."""

    def __init__(self) -> None:
        self.found: Description = {}
        self.paths: dict[int, str] = {}
        self.kept: list[Any] = []  # alive, so that no other object gets their identity

    def add(self, path: str, value: Any) -> None:
        if isinstance(value, _PLAIN) and not isinstance(value, np.generic):
            self.found[path] = _plain(value)
        elif isinstance(value, Mapping):
            self.found[path] = type(value).__name__
            for key, item in value.items():
                self.add(f"{path}[{_plain(key) if isinstance(key, _PLAIN) else type(key).__name__}]", item)
        elif isinstance(value, (set, frozenset)):
            self.found[path] = f"{type(value).__name__} {sorted(map(_plain, value))}"
        elif isinstance(value, (list, tuple)) and all(isinstance(item, _PLAIN) for item in value):
            self.found[path] = ", ".join(map(_plain, value))
        elif isinstance(value, (list, tuple)):
            self.found[path] = f"{len(value)} of them"
            for i, item in enumerate(value):
                self.add(f"{path}[{i}]", item)
        elif (array := _as_array(value)) is not None:
            self.found[path] = _array(array)
        elif isinstance(value, types.ModuleType):
            self.found[path] = value.__name__
        elif id(value) in self.paths:
            self.found[path] = f"the same as {self.paths[id(value)]}"
        else:
            self.paths[id(value)] = path
            self.kept.append(value)
            self._object(path, value)

    def _object(self, path: str, value: Any) -> None:
        if isinstance(value, type):
            self.found[path] = value.__qualname__
            self._class(value)
        elif isinstance(value, functools.partial):
            self.found[path] = "partial"
            self.add(f"{path}.func", value.func)
            self.add(f"{path}.args", value.args)
            self.add(f"{path}.keywords", value.keywords)
        elif isinstance(value, types.MethodType):
            self.found[path] = f"method {value.__func__.__qualname__}"
            self.add(f"{path}.self", value.__self__)
            if not is_project(module_of(value.__func__)):
                self.add(f"{path}.function", value.__func__)
        elif isinstance(function := inspect.unwrap(value) if callable(value) else None, types.FunctionType):
            self._function(path, function)
        elif isinstance(value, _FUNCTIONS) or not (hasattr(value, "__dict__") or hasattr(type(value), "__slots__")):
            self.found[path] = getattr(value, "__qualname__", type(value).__qualname__)
        else:
            self._instance(path, value)

    def _instance(self, path: str, value: Any) -> None:
        self.found[path] = type(value).__qualname__
        self._class(type(value))
        attributes = _attributes(value)
        if is_project(module_of(type(value))):
            # What it was made with. Other attributes, such as results that it keeps, follow from that.
            public = {name: item for name, item in attributes.items() if not name.startswith("_")}
            attributes = _arguments(value, attributes) or public
        elif not is_user(type(value)):
            attributes = _library_state(value, attributes)
        else:
            kept = _internals(type(value))
            attributes = {name: item for name, item in attributes.items() if name not in kept}
        for name, item in attributes.items():
            self.add(f"{path}.{name}", item)

    def _class(self, kind: type) -> None:
        """The source of a user's class and of its bases, with what its methods use."""
        for base in kind.__mro__:
            key = f"class {base.__qualname__}"
            if not is_user(base) or id(base) in self.paths and self.found.get(key):
                continue
            self.paths[id(base)] = key
            self.kept.append(base)
            source = _source(base)
            self.found[key] = source or "without a source"
            self.found[_USER] = "yes"
            for name, item in vars(base).items():
                function = inspect.unwrap(getattr(item, "__func__", getattr(item, "fget", None) or item))
                if isinstance(function, types.FunctionType):
                    if function.__code__.co_filename.startswith("<string"):
                        continue  # a method that @dataclass has written
                    if source and is_user(function):
                        self._uses(f"{key}.{name}", function)
                    else:
                        self.add(f"{key}.{name}", function)
                elif not name.startswith(("__", "_abc_")) and not callable(getattr(item, "__get__", None)):
                    self.add(f"{key}.{name}", item)

    def _function(self, path: str, function: types.FunctionType) -> None:
        if not (is_user(function) or is_project(module_of(function))):
            self.found[path] = f"{module_of(function)}.{function.__qualname__}"  # a library's
            return
        self.found[path] = _source(function) or _without_source(function.__code__)
        if is_user(function):
            self.found[_USER] = "yes"
        self._uses(path, function)

    def _uses(self, path: str, function: types.FunctionType) -> None:
        """Defaults, closures and the globals of a function that are values or the user's code."""
        variables = inspect.getclosurevars(function).nonlocals if function.__closure__ else {}
        defaults: dict[Any, Any] = dict(enumerate(function.__defaults__ or ()))
        defaults |= function.__kwdefaults__ or {}
        for name, item in [*sorted(variables.items()), *((f"default {key}", item) for key, item in defaults.items())]:
            if name != "__class__":
                self.add(f"{path}.{name}", item)
        names = sorted(_names(function.__code__))
        for name in names:
            if name in function.__globals__:
                self._global(f"{path}.{name}", function.__globals__[name], names)

    def _global(self, path: str, item: Any, names: list[str]) -> None:
        if isinstance(item, types.ModuleType):
            if user_file(item.__name__):
                for name in names:
                    if name in vars(item):
                        self._global(f"{path}.{name}", vars(item)[name], names)
        elif isinstance(item, (type, types.FunctionType)):
            if is_user(inspect.unwrap(item)):
                self.add(path, item)
        elif not (isinstance(item, types.BuiltinFunctionType) or _is_projects(item)):
            self.add(path, item)


def _plain(value: Any) -> str:
    if isinstance(value, Enum):
        return str(value)
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, re.Pattern):
        return value.pattern if isinstance(value.pattern, str) else repr(value.pattern)
    if isinstance(value, str):
        return re.sub(r"^/.*/(?=.)", "", value)  # of a path on this machine, the last part
    return repr(value) if isinstance(value, _PLAIN) else type(value).__name__


def _as_array(value: Any) -> np.ndarray | None:
    """An array, a tensor or a number of NumPy, as an array."""
    if isinstance(value, (np.ndarray, np.generic)):
        return np.asarray(value)
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        tensor = value.detach().cpu()
        return np.asarray(tensor.double() if tensor.is_floating_point() else tensor)
    return None


def _array(array: np.ndarray) -> str:
    if array.size <= _PRINTED:
        return repr(array.tolist())
    if array.dtype.hasobject:
        return f"array of shape {array.shape}"
    digest = hashlib.sha256(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes())
    return f"array of shape {array.shape}, checksum {digest.hexdigest()[:12]}"


def _attributes(value: Any) -> dict[str, Any]:
    slots = (name for base in type(value).__mro__ for name in _slots_of(base))
    return {name: getattr(value, name) for name in slots if hasattr(value, name)} | dict(getattr(value, "__dict__", {}))


def _parameters(kinds: Iterable[type]) -> dict[str, None]:
    """The names of the constructors' arguments, each once."""
    names: dict[str, None] = {}
    for kind in kinds:
        if "__init__" in vars(kind) and kind is not object:
            names |= dict.fromkeys(inspect.signature(vars(kind)["__init__"]).parameters)
    return names


def _internals(kind: type) -> set[str]:
    """Private attributes in which the project's bases of a user's class keep something, such as a count of calls."""
    bases = [base for base in kind.__mro__ if is_project(module_of(base))]
    used = {name for base in bases for name in re.findall(r"\bself\.(_\w+)", _source(base))}
    return used - {f"_{name}" for name in _parameters(bases)}


def _library_state(value: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a network; of another library's object the public numbers and texts, as the rest may change."""
    if hasattr(value, "state_dict"):
        return dict(value.state_dict())
    return {
        name: item
        for name, item in attributes.items()
        if not name.startswith("_") and isinstance(item, (*_PLAIN, np.ndarray))
    }


def _slots_of(base: type) -> Iterator[str]:
    slots = vars(base).get("__slots__", ())
    yield from (name for name in ((slots,) if isinstance(slots, str) else slots) if not name.startswith("__"))


def _arguments(value: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes that have the names of the constructors' arguments; empty where one of those has no attribute."""
    found = {}
    for name in _parameters(type(value).__mro__):
        attribute = next((attribute for attribute in (name, f"_{name}") if attribute in attributes), None)
        if attribute:
            found[name] = attributes[attribute]
        elif name != "self":
            return {}
    return found


def _is_projects(item: Any) -> bool:
    """Whether a global was imported from the project, as `TASKS` and its constants are."""
    modules = [module for name, module in list(sys.modules.items()) if is_project(name)]
    return any(item is value for module in modules for value in vars(module).values())


def _names(code: types.CodeType) -> set[str]:
    """The names that a function uses, also those in functions inside it."""
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _source(value: Any) -> str:
    """The source of a function or a class without comments and blank lines; empty where there is none."""
    try:
        if getattr(value, "__name__", "") == "<lambda>":
            return _lambda_source(value)
        return _without_comments(textwrap.dedent(inspect.getsource(value)))
    except (OSError, TypeError, SyntaxError, IndentationError, tokenize.TokenError):
        return ""


def _lambda_source(function: types.FunctionType) -> str:
    """The source of the lambdas that start in the line of `function`, which is one of them."""
    text = "".join(linecache.getlines(function.__code__.co_filename, function.__globals__))
    segments = [
        ast.get_source_segment(text, node) or ""
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Lambda) and node.lineno == function.__code__.co_firstlineno
    ]
    alike = [s for s in segments if _looks_like(s, function.__code__)]
    return "\n".join(dict.fromkeys(" ".join(segment.split()) for segment in alike or segments))


def _looks_like(segment: str, code: types.CodeType) -> bool:
    inner = next(c for c in compile(f"({segment})", "", "eval").co_consts if isinstance(c, types.CodeType))
    # A closure's variables are globals in a lambda that is compiled alone.
    used, here = ({*c.co_names, *c.co_freevars} for c in (code, inner))
    return (inner.co_varnames, inner.co_consts, here) == (code.co_varnames, code.co_consts, used)


def _without_comments(source: str) -> str:
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _without_source(code: types.CodeType) -> str:
    """What is known of a function that was typed at a prompt: its constants and names."""
    constants = [_without_source(c) if isinstance(c, types.CodeType) else repr(c) for c in code.co_consts]
    return f"without a source; constants {', '.join(constants)}; names {', '.join(sorted(code.co_names))}"

"""Describes a run's task (constraint and robot) and its algorithm as text, with their parameters.

The name of a task or an algorithm does not determine it: the user's own can change between two runs. A description
maps paths, such as `constraint.bound`, to text that is the same in every process and Python version: values, and the
source of functions and of the user's classes. The project's own classes are described by their names, because the
commit in info.json determines their code. `differences` lists the changes between two descriptions.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import inspect
import logging
import os
import re
import sys
import types
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np

from store.origin import is_project, is_user, is_user_module, module_of
from store.source import imports_in, names_in, source_of, without_source

Description = dict[str, str]

_USER = "user code"
"""The key that a description has if it includes the user's code."""
_SHOWN = 3
"""The most differences that a message lists."""
_PRINTED = 16
"""The most numbers of an array that are written out. Larger arrays are described by a checksum."""
_WIDTH = 70
_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes, range, slice, PurePath, re.Pattern)
_SEQUENCES = (list, tuple, deque)
_SETS = (set, frozenset)
_WRAPPERS: dict[type, tuple[str, ...]] = {
    functools.partial: ("func", "args", "keywords"),
    functools.partialmethod: ("func", "args", "keywords"),
    functools.cached_property: ("func",),
    property: ("fget", "fset", "fdel"),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
}
"""The attributes of each kind of wrapper that hold its function and arguments."""
_RANDOM = ("Generator", "BitGenerator", "RandomState", "Random", "SeedSequence")
"""Classes of random generators, whose states differ between processes."""


def describe(parts: Mapping[str, Any]) -> Description:
    """Describe named objects: constraints, classes, functions, numbers, tensors, or objects that hold such."""
    describer = _Describer()
    for name, value in parts.items():
        describer.add(name, value)
    return describer.found


def is_own(description: Mapping[str, str]) -> bool:
    """Whether the description includes no code of the user."""
    return _USER not in description


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """What differs between two descriptions, in one line; empty if nothing does."""
    changed = [key for key in {**before, **now} if before.get(key) != now.get(key) and key != _USER]
    # A value tells more than the source around it, and an outer path more than the paths inside it.
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
    """The two values of one key. For texts of several lines, the first two lines that differ."""
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
    """Collects the description. Each object is described once; later paths refer to its first path."""

    def __init__(self) -> None:
        self.found: Description = {}
        self.paths: dict[int, str] = {}
        self.classes: set[type] = set()
        self.kept: list[Any] = []  # keeps objects alive, so that no other object gets their id

    def add(self, path: str, value: Any) -> None:
        path = self._free(path)
        if isinstance(value, Enum):
            self.found[path] = f"{type(value).__name__}.{value.name}"
            self.add(f"{path}.value", value.value)
        elif _is_plain(value):
            self.found[path] = _plain(value)
        elif isinstance(value, Mapping):
            self.found[path] = type(value).__name__
            for key, item in value.items():
                self.add(f"{path}[{_plain(key)}]", item)
        elif isinstance(value, _SETS):
            self.found[path] = f"{type(value).__name__} {_plain(value)}"
        elif isinstance(value, _SEQUENCES) and all(map(_is_plain, value)):
            self.found[path] = ", ".join(map(_plain, value))
        elif isinstance(value, _SEQUENCES):
            self.found[path] = f"{len(value)} of them"
            for i, item in enumerate(value):
                self.add(f"{path}[{i}]", item)
        elif (array := _as_array(value)) is not None:
            if array.dtype.hasobject:
                self.add(path, array.tolist())
            else:
                self.found[path] = _array(array)
        elif isinstance(value, types.ModuleType):
            self.found[path] = value.__name__
        elif id(value) in self.paths:
            self.found[path] = f"the same as {self.paths[id(value)]}"
        else:
            self.paths[id(value)] = path
            self.kept.append(value)
            self._object(path, value)

    def _free(self, path: str) -> str:
        """`path`, or a longer one if it is taken: two keys of a dictionary may have the same text."""
        while path in self.found:
            path += "'"
        return path

    def _object(self, path: str, value: Any) -> None:
        if isinstance(value, type):
            self.found[path] = value.__qualname__
            self._class(value)
        elif isinstance(value, types.FunctionType):
            self._function(path, value)
        elif isinstance(value, types.MethodType):
            self.found[path] = f"method {value.__func__.__qualname__}"
            self.add(f"{path}.self", value.__self__)
            if not is_project(module_of(value.__func__)):
                self.add(f"{path}.function", value.__func__)
        elif isinstance(value, tuple(_WRAPPERS)):
            self.found[path] = type(value).__name__
            for part in next(parts for kind, parts in _WRAPPERS.items() if isinstance(value, kind)):
                if getattr(value, part) is not None:
                    self.add(f"{path}.{part.strip('_')}", getattr(value, part))
        elif name := getattr(value, "__qualname__", None) or getattr(value, "__name__", None):
            self.found[path] = str(name)  # a library function that is not written in Python
            of = getattr(value, "__wrapped__", getattr(value, "__self__", None))
            if of is not None and not isinstance(of, (type, types.ModuleType)):
                self.add(f"{path}.of", of)
        else:
            self.found[path] = type(value).__qualname__
            self._class(type(value))
            for name, item in _state(value).items():
                self.add(f"{path}.{name}", item)

    def _class(self, kind: type) -> None:
        """Describe the attributes of a user's class and of its bases, if these are the user's too."""
        for base in kind.__mro__:
            if not is_user(base) or base in self.classes:
                continue
            self.classes.add(base)
            key = self._free(f"class {base.__qualname__}")
            self.found[key] = f"of {', '.join(parent.__qualname__ for parent in base.__bases__)}"
            self.found[_USER] = "yes"
            for name, item in vars(base).items():
                if not _is_made_by_python(base, name, item):
                    self.add(f"{key}.{name}", item)

    def _function(self, path: str, function: types.FunctionType) -> None:
        if is_user(function):
            self.found[_USER] = "yes"
        elif not is_project(module_of(function)):
            self.found[path] = f"{module_of(function)}.{function.__qualname__}"  # a library function
            if hasattr(function, "__wrapped__"):
                self.add(f"{path}.of", function.__wrapped__)
            return
        self.found[path] = source_of(function) or without_source(function.__code__)
        self._uses(path, function)

    def _uses(self, path: str, function: types.FunctionType) -> None:
        """Describe the closure, defaults, globals and imports that a function uses: values and the user's code."""
        code, names = function.__code__, sorted(names_in(function.__code__))
        for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
            if name != "__class__" and cell != types.CellType():
                self._used(f"{path}.{name}", cell.cell_contents, names)
        defaults: dict[Any, Any] = dict(enumerate(function.__defaults__ or ())) | (function.__kwdefaults__ or {})
        for key, item in defaults.items():
            self.add(f"{path}.default {key}", item)
        for name in names:
            if name in function.__globals__ and not name.startswith("__") and name not in code.co_freevars:
                item = function.__globals__[name]
                if not _is_projects(item):
                    self._used(f"{path}.{name}", item, names)
        for name in sorted(imports_in(code)):
            if is_user_module(name):
                self._used(f"{path}.{name}", importlib.import_module(name), names)

    def _used(self, path: str, item: Any, names: Sequence[str], inside: tuple[types.ModuleType, ...] = ()) -> None:
        """Describe a variable of a function that uses `names`. Of a user's module, only those names are described."""
        if isinstance(item, types.ModuleType):
            if is_user_module(item.__name__) and item not in inside:
                for name in names:
                    if name in vars(item) and not name.startswith("__"):
                        self._used(f"{path}.{name}", vars(item)[name], names, (*inside, item))
        elif isinstance(item, logging.Logger) or (_is_library(item) and path.endswith(f".{item.__name__}")):
            pass  # the source of the function names it
        else:
            self.add(path, item)


def _is_library(item: Any) -> bool:
    """Whether a variable is a library's function or class."""
    kinds = (type, types.FunctionType, types.BuiltinFunctionType)
    bound = isinstance(getattr(item, "__self__", None), (types.ModuleType, type, type(None)))
    return isinstance(item, kinds) and bound and not is_user(item) and not hasattr(item, "__wrapped__")


def _is_made_by_python(kind: type, name: str, item: Any) -> bool:
    """Whether Python made this attribute for the class, or for a dataclass, a named tuple or an Enum."""
    private = ("_",) if issubclass(kind, Enum) or hasattr(kind, "_fields") else ("__", "_abc_")
    if isinstance(item, types.FunctionType):
        written = inspect.unwrap(item)
        generated = hasattr(kind, "__dataclass_fields__") or hasattr(kind, "_fields")
        own = is_user(written) and not (generated and written.__code__.co_filename.startswith(("<string", "<attrs")))
        return name.startswith(private) and not own
    return name.startswith(private) or isinstance(item, types.MemberDescriptorType)


def _is_plain(value: Any) -> bool:
    return isinstance(value, _PLAIN) and not isinstance(value, (np.generic, Enum))


def _plain(value: Any) -> str:
    if isinstance(value, (str, PurePath)) and os.path.isabs(value) and os.path.isdir(value):
        return "a folder"  # its name changes if code and data are moved
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, re.Pattern):
        return f"{value.pattern!r}, flags {value.flags}"
    if isinstance(value, str):
        return re.sub(r"^/.*/(?=.)", "", value)  # only the last part of an absolute path
    if isinstance(value, (*_SETS, tuple)):
        items = map(_plain, value)
        return f"({', '.join(items if isinstance(value, tuple) else sorted(items))})"
    return repr(value) if _is_plain(value) else getattr(value, "__qualname__", type(value).__qualname__)


def _as_array(value: Any) -> np.ndarray | None:
    """Convert an array, a tensor, a NumPy number or another library's table to an array; None for other values."""
    if isinstance(value, (np.ndarray, np.generic)):
        return np.asarray(value)
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        tensor = value.detach().cpu()
        return np.asarray(tensor.double() if tensor.is_floating_point() else tensor)
    if hasattr(type(value), "__array__") and not is_user(type(value)):
        return np.asarray(value)
    return None


def _array(array: np.ndarray) -> str:
    if array.size <= _PRINTED:
        return repr(array.tolist())
    digest = hashlib.sha256(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes())
    return f"array of shape {array.shape}, checksum {digest.hexdigest()[:12]}"


def _state(value: Any) -> dict[str, Any]:
    """The attributes that determine an object, as far as they can be read."""
    import torch  # only here: reading results needs no torch

    kind = type(value)
    if not is_user(kind) and not is_project(module_of(kind)):
        with contextlib.suppress(Exception):  # an object may raise anything here
            repr(value)  # some objects store their text when first asked, such as Gymnasium's boxes
    slots = (name for base in kind.__mro__ for name in _slots_of(base))
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes |= getattr(value, "__dict__", {})
    attributes = {name: item for name, item in attributes.items() if not _is_cached(kind, name)}
    public = {name: item for name, item in attributes.items() if not name.startswith("_")}
    if is_project(module_of(kind)):
        # The constructor's arguments. Other attributes, such as cached results, follow from them.
        return _arguments(value, attributes) or public
    if isinstance(value, torch.nn.Module):
        own = {name: item for name, item in attributes.items() if name not in vars(torch.nn.Module())}
        return own | value._parameters | value._buffers | value._modules
    if is_user(kind):
        kept = _internals(kind)
        return {name: item for name, item in attributes.items() if name not in kept}
    if hasattr(value, "__dict__"):  # a library's object: its other attributes may change
        return {name: item for name, item in public.items() if _is_data(item)}
    return {} if any(base.__name__ in _RANDOM for base in kind.__mro__) else _pickled(value)


def _is_cached(kind: type, name: str) -> bool:
    """Whether an attribute is the cached value of a property."""
    return isinstance(inspect.getattr_static(kind, name, None), functools.cached_property)


def _pickled(value: Any) -> dict[str, Any]:
    """The name or the arguments from which pickle restores an object without attributes."""
    try:
        parts = value.__reduce_ex__(2)
    except Exception:  # an object that cannot be pickled may raise anything
        return {}
    return {"name": parts} if isinstance(parts, str) else {"arguments": parts[1]}


def _is_data(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(map(_is_data, value.values()))
    if isinstance(value, (*_SEQUENCES, *_SETS)):
        return all(map(_is_data, value))
    return isinstance(value, Enum) or _is_plain(value) or _as_array(value) is not None


def _parameters(kinds: Iterable[type]) -> dict[str, None]:
    """The names of the constructors' arguments, each once."""
    names: dict[str, None] = {}
    for kind in kinds:
        if "__init__" in vars(kind) and kind is not object:
            names |= dict.fromkeys(inspect.signature(vars(kind)["__init__"]).parameters)
    return names


def _internals(kind: type) -> set[str]:
    """Private attributes of a user's class that its bases in the project use, such as a count of calls."""
    bases = [base for base in kind.__mro__ if is_project(module_of(base))]
    used = {name for base in bases for name in re.findall(r"\bself\.(_\w+)", source_of(base))}
    return used - {f"_{name}" for name in _parameters(bases)}


def _slots_of(base: type) -> Iterator[str]:
    slots = vars(base).get("__slots__", ())
    yield from (name for name in ((slots,) if isinstance(slots, str) else slots) if not name.startswith("__"))


def _arguments(value: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes named like the constructors' arguments; empty if an argument has no such attribute."""
    found = {}
    for name in _parameters(type(value).__mro__):
        attribute = next((attribute for attribute in (name, f"_{name}") if attribute in attributes), None)
        if attribute:
            found[name] = attributes[attribute]
        elif name != "self":
            return {}
    return found


def _is_projects(item: Any) -> bool:
    """Whether a global is an object of a module of the project, such as `TASKS`. Plain values are not."""
    modules = [module for name, module in list(sys.modules.items()) if is_project(name)]
    return not _is_plain(item) and any(item is value for module in modules for value in vars(module).values())

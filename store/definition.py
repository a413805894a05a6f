"""What a run is trained on, as text: the task's constraint and robot, and the algorithm, with their parameters.

Names of tasks and algorithms do not tell what they stand for: a user's own can change between two runs. A description
maps paths, such as `constraint.bound`, to text that is the same in every process and Python version: values, and the
source of functions and of the user's classes. The project's own classes are described by their name, as the commit in
info.json stands for their code. `differences` says what has changed between two descriptions.
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
"""The key that a description has if something of it is the user's code."""
_SHOWN = 3
"""The most differences that a message lists."""
_PRINTED = 16
"""The most numbers of an array that are written out; of larger ones, the checksum is."""
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
"""What is behind a function, for things that hold one."""
_RANDOM = ("Generator", "BitGenerator", "RandomState", "Random", "SeedSequence")
"""Classes of random generators, whose states are another in every process."""


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
        self.classes: set[type] = set()
        self.kept: list[Any] = []  # alive, so that no other object gets their identity

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
        """`path`, or where two things have it, as two keys of a dictionary with the same text, a longer one."""
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
            self.found[path] = str(name)  # a library's function that is not written in Python
            of = getattr(value, "__wrapped__", getattr(value, "__self__", None))
            if of is not None and not isinstance(of, (type, types.ModuleType)):
                self.add(f"{path}.of", of)
        else:
            self.found[path] = type(value).__qualname__
            self._class(type(value))
            for name, item in _state(value).items():
                self.add(f"{path}.{name}", item)

    def _class(self, kind: type) -> None:
        """What a user's class and its bases define."""
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
            self.found[path] = f"{module_of(function)}.{function.__qualname__}"  # a library's
            if hasattr(function, "__wrapped__"):
                self.add(f"{path}.of", function.__wrapped__)
            return
        self.found[path] = source_of(function) or without_source(function.__code__)
        self._uses(path, function)

    def _uses(self, path: str, function: types.FunctionType) -> None:
        """Defaults, closures, imports and the globals of a function that are values or the user's code."""
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
        """A variable of a function that uses `names`; of a user's module, what has one of those names."""
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
    """Whether a class has this only because it is a class, a dataclass, a named tuple or an Enum."""
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
        return "a folder"  # its name changes where code and data are moved
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, re.Pattern):
        return f"{value.pattern!r}, flags {value.flags}"
    if isinstance(value, str):
        return re.sub(r"^/.*/(?=.)", "", value)  # of a path on this machine, the last part
    if isinstance(value, (*_SETS, tuple)):
        items = map(_plain, value)
        return f"({', '.join(items if isinstance(value, tuple) else sorted(items))})"
    return repr(value) if _is_plain(value) else getattr(value, "__qualname__", type(value).__qualname__)


def _as_array(value: Any) -> np.ndarray | None:
    """An array, a tensor, a number of NumPy or another library's table, as an array."""
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
    """What an object was made with, as far as it tells."""
    import torch  # only here: reading results needs no torch

    kind = type(value)
    if not is_user(kind) and not is_project(module_of(kind)):
        with contextlib.suppress(Exception):  # whatever an object without a text raises
            repr(value)  # some objects keep their text from then on, as Gymnasium's boxes do
    slots = (name for base in kind.__mro__ for name in _slots_of(base))
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes |= getattr(value, "__dict__", {})
    attributes = {name: item for name, item in attributes.items() if not _is_cached(kind, name)}
    public = {name: item for name, item in attributes.items() if not name.startswith("_")}
    if is_project(module_of(kind)):
        # What it was made with. Other attributes, such as results that it keeps, follow from that.
        return _arguments(value, attributes) or public
    if isinstance(value, torch.nn.Module):
        own = {name: item for name, item in attributes.items() if name not in vars(torch.nn.Module())}
        return own | value._parameters | value._buffers | value._modules
    if is_user(kind):
        kept = _internals(kind)
        return {name: item for name, item in attributes.items() if name not in kept}
    if hasattr(value, "__dict__"):  # a library's: its other attributes may change
        return {name: item for name, item in public.items() if _is_data(item)}
    return {} if any(base.__name__ in _RANDOM for base in kind.__mro__) else _pickled(value)


def _is_cached(kind: type, name: str) -> bool:
    """Whether an attribute keeps what a property has computed."""
    return isinstance(inspect.getattr_static(kind, name, None), functools.cached_property)


def _pickled(value: Any) -> dict[str, Any]:
    """What pickle keeps of an object without attributes."""
    try:
        parts = value.__reduce_ex__(2)
    except Exception:  # whatever such an object raises: it cannot be pickled
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
    """Private attributes in which the project's bases of a user's class keep something, such as a count of calls."""
    bases = [base for base in kind.__mro__ if is_project(module_of(base))]
    used = {name for base in bases for name in re.findall(r"\bself\.(_\w+)", source_of(base))}
    return used - {f"_{name}" for name in _parameters(bases)}


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
    """Whether a global is an object that was imported from the project, as `TASKS` is. Values count for themselves."""
    modules = [module for name, module in list(sys.modules.items()) if is_project(name)]
    return not _is_plain(item) and any(item is value for module in modules for value in vars(module).values())

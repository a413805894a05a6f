"""Tells whether a module or a file belongs to the project, to a library or to the user."""

from __future__ import annotations

import importlib.util
import site
import sys
import sysconfig
import types
from functools import cache
from importlib.metadata import PathDistribution
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_INTERPRETER = {"sitecustomize", "usercustomize"}
"""Modules that configure the interpreter at its start."""
_PROJECT = {"algos", "bench", "constraints", "core", "envs", "plot", "plots", "run", "store", "sweep", "tables"}


def is_project(module: str) -> bool:
    """Whether the module of this name is one of the project's packages or commands."""
    return module.partition(".")[0] in _PROJECT


def user_file(module: str) -> Path | None:
    """The source file of a loaded module of the user; None for a module of the project or of a library."""
    return None if is_project(module) else _user_path(getattr(sys.modules.get(module), "__file__", None))


def is_user_module(module: str) -> bool:
    """Whether a module, loaded or not, is the user's own."""
    if module in sys.modules or is_project(module):
        return user_file(module) is not None
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return False
    return spec is not None and _user_path(spec.origin) is not None


def module_of(value: Any) -> str:
    """The name of the module that defines a function or a class; empty if it is unknown.

    For a function made by a decorator, it is the decorator's module, even if `__module__` differs.
    """
    if isinstance(value, types.FunctionType):
        return value.__globals__.get("__name__") or ""
    return getattr(value, "__module__", None) or ""


def is_user(value: Any) -> bool:
    """Whether a function or a class is the user's own code. Code typed at a prompt is the user's too."""
    module = module_of(value)
    if is_project(module) or not module:
        return False
    if module == "__main__":
        return not _main_is_command()
    return module not in sys.modules or user_file(module) is not None


def user_files() -> list[Path]:
    """The source files of all loaded modules that are neither the project's nor a library's."""
    return sorted({file for module in list(sys.modules) if (file := user_file(module))})


def project_files() -> list[Path]:
    """The source files of all loaded modules of the project."""
    paths = [ROOT.joinpath(*module.split(".")) for module in list(sys.modules) if is_project(module)]
    files = [file for path in paths for file in (path.with_suffix(".py"), path / "__init__.py")]
    return sorted(file for file in files if file.is_file())


def _user_path(file: str | None) -> Path | None:
    """The path of a .py file that belongs to neither a library nor the commands; None for other files."""
    if not file:
        return None
    path = Path(file).resolve()
    if path in _commands() or path.stem in _INTERPRETER or _is_library(path):
        return None
    return path if path.is_file() and path.suffix == ".py" else None  # some modules invent the name of a file


def _is_library(path: Path) -> bool:
    if {"site-packages", "dist-packages"} & set(path.parts) or any(f in path.parents for f in _libraries()):
        return True
    return any(path.relative_to(folder).parts[0] in _installed(folder) for folder in path.parents)


@cache
def _installed(folder: Path) -> set[str]:
    """The names in `folder` that belong to installed libraries, as `pip install --target` leaves them."""
    found = [PathDistribution(about).files or [] for about in folder.glob("*.dist-info")]
    return {file.parts[0] for files in found for file in files}


def _main_is_command() -> bool:
    file = getattr(sys.modules["__main__"], "__file__", None)
    return bool(file) and Path(file).resolve() in _commands()


@cache
def _commands() -> set[Path]:
    return {ROOT / "run.py", ROOT / "plot.py"}


@cache
def _libraries() -> set[Path]:
    known = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    known |= {*site.getsitepackages(), site.getusersitepackages(), str(Path(sys.executable).parent)}
    # An environment may lie below the standard library's folder, but never below the user's sources.
    return {Path(folder).resolve() for folder in known}

"""`plugin=my.py`: your own files, which register tasks, maps and algorithms when they are imported."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from core.words import ConfigError
from store.files import one_line, user_path

KEY = "plugin"
HELP = "your own files that register tasks and algorithms, comma separated"

_loaded: dict[Path, bool] = {}
"""The plugins of this process in their order, and whether the import of each has ended."""


def load_plugins(words: Sequence[str]) -> list[str]:
    """Import the files of `plugin=`, and return the other words.

    Raises ConfigError, with file and line, if one of them cannot be imported.
    """
    mine = [word for word in words if word.startswith(f"{KEY}=")]
    if len(mine) > 1:
        raise ConfigError(f"key {KEY!r} given twice: one {KEY}= takes several files, comma separated")
    value = mine[0].partition("=")[2] if mine else ""
    texts = value.split(",") if mine else []
    if not all(texts):
        raise ConfigError(f"bad value {value!r} for {KEY}: expected Python files (.py)")
    paths = [user_path(text).absolute() for text in texts]
    for path in paths:  # before any of them is imported
        if not path.is_file() or path.suffix != ".py":
            missing = "" if path.is_file() else ", and there is no such file"
            raise ConfigError(f"bad value {str(path)!r} for {KEY}: expected a Python file (.py){missing}")
    for path in paths:
        _load(path)
    return [word for word in words if word not in mine]


def plugin_words() -> list[str]:
    """The word that makes another process load the same plugins; an empty list without plugins."""
    return [f"{KEY}={','.join(map(str, _loaded))}"] if _loaded else []


def refuse_to_train_in_plugin() -> None:
    """Raise ConfigError while a plugin is being imported."""
    if not all(_loaded.values()):
        raise ConfigError('a plugin must not train when it is imported: train below `if __name__ == "__main__":`')


def _load(path: Path) -> None:
    if path in _loaded:
        return
    if _is_imported(path):
        _loaded[path] = True
        return
    name = path.stem
    spec = importlib.util.find_spec(name) if name.isidentifier() else None
    if name in sys.modules or (spec and (not spec.origin or Path(spec.origin).resolve() != path.resolve())):
        raise ConfigError(f"{KEY} {path} has the same name as another module, {name}: rename it")
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader  # it has the suffix .py
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.append(str(path.parent))  # for the files beside it; last, so that they do not hide the project's own
    _loaded[path] = False
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name], _loaded[path]
        sys.path.remove(str(path.parent))
        reason = one_line(error) if isinstance(error, Exception) else f"it ends the program ({error})"
        raise ConfigError(f"{KEY} {_place(error, path)}: {type(error).__name__}: {reason}") from error
    _loaded[path] = True


def _is_imported(path: Path) -> bool:
    """Whether the file is already a module of this process, such as a program that is its own plugin."""
    files = (getattr(sys.modules.get(name), "__file__", None) for name in ("__main__", path.stem))
    return any(file and Path(file).resolve() == path.resolve() for file in files)


def _place(error: BaseException, path: Path) -> str:
    """File and line of an error: in the plugin, or else where it was raised."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}, line {error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    frame = next((frame for frame in reversed(frames) if frame.filename == str(path)), None)
    return f"{path}, line {frame.lineno}" if frame else str(path)

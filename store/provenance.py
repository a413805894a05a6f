"""The provenance of a run: versions, git commit, command and machine."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from store.origin import ROOT, project_files, user_files

_PACKAGES = ("numpy", "scipy", "gymnasium", "mujoco", "pybullet", "omegaconf")


def describe_environment(command: Sequence[str]) -> dict[str, Any]:
    """The content of `info.json`: versions, commit, command, machine, start time, and sources that the commit lacks.

    It contains no path of this machine.
    """
    # PyTorch itself names its build (+cpu, +cu130), which the metadata of a package may leave out.
    versions: dict[str, str | None] = {"python": platform.python_version(), "torch": str(torch.__version__)}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    described = _git_describe(Path(__file__))
    return {
        "versions": versions,
        "commit": described and described.removesuffix("-dirty"),
        "dirty": described and described.endswith("-dirty"),
        "command": command_line(command),
        "sources": _describe_sources([*user_files(), *_untracked_modules()]),
        "platform": platform.platform(),
        "processor": processor(),
        "preloaded": _preloaded_libraries(),
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def processor() -> str:
    """The name of the CPU: float rounding depends on its instructions."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _preloaded_libraries() -> list[str]:
    """The names of the libraries in LD_PRELOAD, which may change the arithmetic too (docs/speed.md)."""
    return [Path(file).name for file in re.split("[ :]+", os.environ.get("LD_PRELOAD", "")) if file]


def command_line(words: Sequence[str]) -> str:
    """Quote words for a shell. Absolute paths, alone or after `=` or a comma, are cut to their last part."""
    return shlex.join(re.sub(r"(^|=|,)/[^,]*/(?=[^,])", r"\1", word) for word in words)


def _untracked_modules() -> list[Path]:
    """The source files of the project's loaded modules that the commit of this code does not have."""
    try:
        _git(Path(__file__), "ls-files", "--error-unmatch", Path(__file__).name)
        tracked = _git(ROOT / "run.py", "ls-files", "--", "*.py").splitlines()
    except (OSError, subprocess.SubprocessError):
        return []
    return [file for file in project_files() if file.relative_to(ROOT).as_posix() not in tracked]


def _describe_sources(files: Sequence[Path]) -> list[dict[str, Any]]:
    """Name, checksum and commit of each of `files`, without those that the commit of this code includes.

    The commit is None for a file that is in no repository. `dirty` tells whether the file differs from its commit.
    """
    inside = [str(file) for file in files if file.is_relative_to(ROOT)]
    try:
        tracked = _git(Path(__file__), "ls-files", "--full-name", "--", *inside).splitlines() if inside else []
    except (OSError, subprocess.SubprocessError):
        tracked = []
    sources = []
    for file in files:
        name = str(file.relative_to(ROOT)) if str(file) in inside else file.name
        if str(file) in inside and name in tracked:
            continue
        described = _git_describe(file)
        sources.append(
            {
                "file": name,
                "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
                "commit": described and described.removesuffix("-dirty"),
                "dirty": described and _git(file, "status", "--porcelain", "--", file.name) != "",
            }
        )
    return sources


def _git_describe(file: Path) -> str | None:
    """The commit of the repository that has `file`, plus `-dirty` if tracked files are changed; None without one."""
    try:
        # If the package is installed in an environment inside another repository, git would describe that one.
        _git(file, "ls-files", "--error-unmatch", file.name)
        return _git(file, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(file: Path, *arguments: str) -> str:
    """The output of git, run in the folder of `file`. Raises OSError or SubprocessError."""
    command = ["git", "-C", str(file.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip()

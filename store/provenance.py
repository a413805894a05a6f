"""Where a run comes from: versions, git commit, command and machine."""

from __future__ import annotations

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

_PACKAGES = ("numpy", "scipy", "gymnasium", "mujoco", "pybullet", "omegaconf")


def describe_environment(command: Sequence[str]) -> dict[str, Any]:
    """The content of `info.json`: versions, git commit, command, start time. It names no path of this machine."""
    # PyTorch itself names its build (+cpu, +cu130), which the metadata of a package may leave out.
    versions: dict[str, str | None] = {"python": platform.python_version(), "torch": torch.__version__}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    described = _git_describe()
    return {
        "versions": versions,
        "commit": described and described.removesuffix("-dirty"),
        "dirty": described and described.endswith("-dirty"),
        # An absolute path, alone or after `key=`, is cut to its last part.
        "command": shlex.join(re.sub(r"(^|=)/.*/(?=.)", r"\1", word) for word in command),
        "platform": platform.platform(),
        "processor": processor(),
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def processor() -> str:
    """The name of the CPU: float rounding depends on its instructions."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _git_describe() -> str | None:
    """The commit of this code, plus `-dirty` if tracked files are changed; None outside a repository."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip()

    try:
        # If the package is installed in an environment inside another repository, git would describe that one.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None

"""NVIDIA's Multi-Process Service (MPS), which lets processes share a GPU."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import torch

MPS = "nvidia-cuda-mps-control"


@contextmanager
def shared_gpu(device: torch.device) -> Iterator[dict[str, str]]:
    """Run NVIDIA's Multi-Process Service and yield the environment variables that processes need to use it.

    Yields {} if `device` is no GPU, or if the service is missing or does not start. The service runs kernels of several
    processes side by side. Without it, a GPU runs the kernels of one process at a time.
    """
    if device.type != "cuda" or not shutil.which(MPS):
        yield {}
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # the service may still write
        environment = {"CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}

        def control(*options: str, text: str = "") -> None:
            command = [MPS, *options]
            subprocess.run(
                command,
                input=text,
                text=True,
                env=os.environ | environment,
                check=True,
                timeout=30,
                capture_output=True,
            )

        try:
            control("-d")
        except (OSError, subprocess.SubprocessError) as error:
            print(f"no Multi-Process Service, so processes take turns: {error}", file=sys.stderr)
            yield {}
            return
        try:
            yield environment
        finally:
            try:
                control(text="quit\n")
            except (OSError, subprocess.SubprocessError) as error:
                print(f"the Multi-Process Service may still run: {error}", file=sys.stderr)

"""The common look of all figures, and how they are saved."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from plots.paper import BEYOND, COLORS, FAMILIES, LATER, first_beyond
from store.folder import LONGEST_NAME

FORMATS = ("png", "pdf")

OWN_COLORS = (
    "#0000ff",
    "#ff1493",
    "#00c800",
    "#8b0000",
    "#ffc400",
    "#00bfff",
    "#6a5acd",
    "#808000",
    "#a0a0a0",
    "#d2a679",
)
OWN_LINES = ("dashdot", "dotted", (0, (5, 1, 1, 1, 1, 1)))
"""Colours and line styles of the algorithms of `own_algos`, which take them in turn."""


def own_algos(algos: Iterable[str]) -> list[str]:
    """The algorithms among `algos` that are not in `COLORS` or `LATER`, sorted: `own` of `color_of` and `line_of`.

    They are the user's own and those of sources with a label (`plots.others`).
    """
    return sorted({algo for algo in algos if algo not in COLORS and algo not in LATER})


def color_of(algo: str, own: Sequence[str]) -> str:
    """The colour of `algo`; `own` is what `own_algos` returns for all algorithms in the results."""
    return (COLORS | LATER).get(algo) or OWN_COLORS[own.index(algo) % len(OWN_COLORS)]


def line_of(algo: str, own: Sequence[str], points: int) -> dict[str, Any]:
    """Keyword arguments of `Axes.plot` for a line through `points` points; `own` as in `color_of`."""
    if algo in COLORS or algo in LATER:
        line: Any = "dashed" if algo in (*FAMILIES["SAC family"], "SGauge", "ARAM") else "solid"
    else:
        line = OWN_LINES[own.index(algo) // len(OWN_COLORS) % len(OWN_LINES)]
    marker = "." if 0 < points < 20 else ""
    return {"color": color_of(algo, own), "linestyle": line, "linewidth": 1.5, "marker": marker}


def legend_handles(axes: Axes, algos: Sequence[str]) -> list[Any]:
    """The handles of a legend of `axes`, which has a labelled line for each of `algos`, in the order of `order_algos`.

    If only some of the algorithms are the paper's, a heading stands above the others.
    """
    handles = axes.get_legend_handles_labels()[0]
    if place := first_beyond(algos):
        handles.insert(place, Line2D([], [], linestyle="none", label=BEYOND))
    return handles


def plain(axes: Axes) -> None:
    """Add a light grid; remove the frame on top and on the right."""
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, folder: Path, name: str, formats: Sequence[str]) -> list[Path]:
    """Save as `folder/name` in all image formats among `formats`, and return the files.

    Characters that are awkward in a file name become _. A name that is too long is cut and gets a checksum.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w+,=.\[\]-]+", "_", name)
    if len(os.fsencode(name)) > LONGEST_NAME - len(".png"):  # the checksum keeps cut names apart
        name = f"{name[:50]},{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    paths = [folder / f"{name}.{suffix}" for suffix in formats if suffix in FORMATS]
    for path in paths:
        # The whole benchmark has dozens of figures: compress lightly, and compute each layout once for both formats.
        options: dict[str, Any] = {"pil_kwargs": {"compress_level": 2}} if path.suffix == ".png" else {}
        figure.savefig(path, dpi=150, **options)
        figure.set_layout_engine("none")
    return paths

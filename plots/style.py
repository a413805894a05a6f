"""How every figure looks, and how it is saved."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from plots.paper import COLORS, FAMILIES
from store.folder import LONGEST_NAME

FORMATS = ("png", "pdf")
LATER = {
    "DGauge": ("#b5a100", "solid"),
    "SGauge": ("#ff6f61", "dashed"),
    "DFlow": ("#4b6cb7", "solid"),
    "SFlow": ("#2e8b57", "dashed"),
}
"""Colours and lines of methods that are newer than the paper."""


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
"""Colours and lines of algorithms of one's own. Those of one folder of results take them in turn."""


def own_algos(algos: Iterable[str]) -> list[str]:
    """The names among `algos` that have no colour yet, in a fixed order; `color_of` and `line_of` take it."""
    return sorted({algo for algo in algos if algo not in COLORS and algo not in LATER})


def color_of(algo: str, own: Sequence[str]) -> str:
    """The colour of `algo`; `own` are the algorithms of one's own in the folder of results (`own_algos`)."""
    if algo in LATER:
        return LATER[algo][0]
    return COLORS.get(algo) or OWN_COLORS[own.index(algo) % len(OWN_COLORS)]


def line_of(algo: str, own: Sequence[str], points: int) -> dict[str, Any]:
    """Keywords of a line through so many points; `own` as in `color_of`."""
    if algo in LATER:
        line: Any = LATER[algo][1]
    elif algo in COLORS:
        line = "dashed" if algo in FAMILIES["SAC family"] else "solid"
    else:
        line = OWN_LINES[own.index(algo) // len(OWN_COLORS) % len(OWN_LINES)]
    marker = "." if 0 < points < 20 else ""
    return {"color": color_of(algo, own), "linestyle": line, "linewidth": 1.5, "marker": marker}


def plain(axes: Axes) -> None:
    """A light grid, and no frame on top and on the right."""
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, folder: Path, name: str, formats: Sequence[str]) -> list[Path]:
    """Save as `folder/name` in the `formats` of figures. Characters that are awkward in a file name become _."""
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w+,=.\[\]-]+", "_", name)
    if len(os.fsencode(name)) > LONGEST_NAME - len(".png"):  # with a checksum, as the names of runs are told apart
        name = f"{name[:50]},{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    paths = [folder / f"{name}.{suffix}" for suffix in formats if suffix in FORMATS]
    for path in paths:
        # The whole benchmark has dozens of figures: compress lightly, and compute each layout once for both formats.
        options: dict[str, Any] = {"pil_kwargs": {"compress_level": 2}} if path.suffix == ".png" else {}
        figure.savefig(path, dpi=150, **options)
        figure.set_layout_engine("none")
    return paths

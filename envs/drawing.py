"""Pictures of a planar arm and of a feasible set, drawn without OpenGL and without a display."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw

SIZE = 480
"""Height and width of a picture in pixels."""
_FINE = 2  # lines are drawn this many times as large and scaled down, so that their edges are smooth
_VIEW = 0.33  # metres from the centre of the picture to its edge
_ARENA = 0.27  # targets lie in a square of this half width, in metres
_PAPER, _GRID, _LIMIT = (250, 250, 250), (214, 219, 224), (255, 165, 60)
_ARM, _JOINT, _TARGET = (0, 102, 153), (35, 45, 55), (230, 51, 51)
_SET, _SET_EDGE, _ACTION = (196, 230, 200), (40, 130, 70), (200, 60, 20)

Point = tuple[float, float]


def draw_arm(elbow: Point, tip: Point, target: Point, limit: float) -> np.ndarray:
    """Picture (480, 480, 3), uint8, of an arm with its shoulder at the origin; positions in metres.

    The two orange lines at the elbow are the stops of the forearm, at +-`limit` rad from the direction of the upper
    arm.
    """
    image = Image.new("RGB", (SIZE * _FINE, SIZE * _FINE), _PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle((*_pixel((-_ARENA, _ARENA)), *_pixel((_ARENA, -_ARENA))), outline=_GRID, width=2 * _FINE)
    _disc(draw, (0.0, 0.0), math.hypot(*elbow) + math.dist(elbow, tip), outline=_GRID)
    _disc(draw, target, 0.012, fill=_TARGET)
    for start, end in (((0.0, 0.0), elbow), (elbow, tip)):
        draw.line((*_pixel(start), *_pixel(end)), fill=_ARM, width=round(_pixels(0.02)))
        _disc(draw, end, 0.01, fill=_ARM)
    _disc(draw, (0.0, 0.0), 0.013, fill=_JOINT)
    straight = math.atan2(elbow[1], elbow[0])
    for angle in (straight - limit, straight + limit):
        ends = [_pixel((elbow[0] + r * math.cos(angle), elbow[1] + r * math.sin(angle))) for r in (0.0, 0.05)]
        draw.line((*ends[0], *ends[1]), fill=_LIMIT, width=2 * _FINE)
    _disc(draw, elbow, 0.006, fill=_JOINT)
    return np.array(image.resize((SIZE, SIZE), Image.Resampling.BOX))


def draw_set(picture: np.ndarray, boundary: np.ndarray, action: np.ndarray | None) -> np.ndarray:
    """A copy of `picture` (h, w, 3) with a feasible set in its upper right corner.

    `boundary` (k, 2) are points around the set, in order; `action` (2,) is the last executed action, None before the
    first. The frame is the box [-1, 1]^2, with the first coordinate to the right.
    """
    side, margin = 128, 10
    image = Image.new("RGB", (side * _FINE, side * _FINE), _PAPER)
    draw = ImageDraw.Draw(image)
    edge = 6 * _FINE
    scale = side * _FINE / 2 - edge

    def place(point: np.ndarray) -> Point:
        return side * _FINE / 2 + scale * float(point[0]), side * _FINE / 2 - scale * float(point[1])

    draw.polygon([place(point) for point in boundary], fill=_SET, outline=_SET_EDGE, width=_FINE)
    for low, high in (((-1, 0), (1, 0)), ((0, -1), (0, 1))):
        draw.line((*place(np.array(low)), *place(np.array(high))), fill=_GRID, width=_FINE)
    draw.rectangle((*place(np.array((-1, 1))), *place(np.array((1, -1)))), outline=_JOINT, width=_FINE)
    if action is not None:
        x, y = place(action)
        draw.ellipse((x - 4 * _FINE, y - 4 * _FINE, x + 4 * _FINE, y + 4 * _FINE), fill=_ACTION)
    inset = np.array(image.resize((side, side), Image.Resampling.BOX))
    out = picture.copy()
    out[margin : margin + side, -margin - side : -margin] = inset
    return out


def _pixels(length: float) -> float:
    return length / _VIEW * SIZE * _FINE / 2


def _pixel(point: Point) -> Point:
    return SIZE * _FINE / 2 + _pixels(point[0]), SIZE * _FINE / 2 - _pixels(point[1])


def _disc(draw: ImageDraw.ImageDraw, centre: Point, radius: float, **colours: tuple[int, int, int]) -> None:
    (x, y), r = _pixel(centre), _pixels(radius)
    draw.ellipse((x - r, y - r, x + r, y + r), width=_FINE, **colours)

"""Pictures of the planning domains, drawn with Pillow, and the window that shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]


class Display:
    """A pygame window that opens with the first frame.

    :param fps: frames per second at which :meth:`show` paces itself
    """

    _open: ClassVar[int] = 0  # pygame has one window, which the last of several displays closes

    def __init__(self, fps: int) -> None:
        self.fps = fps
        self._window: Any = None
        self._clock: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {"fps": self.fps}  # a copy opens a window of its own

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def show(self, frame: Frame) -> None:
        """Show a frame ``(height, width, 3)``.

        :raises gymnasium.error.DependencyNotInstalled: if pygame is missing
        """
        try:
            import pygame
        except ImportError as error:
            from gymnasium.error import DependencyNotInstalled

            raise DependencyNotInstalled(
                'render_mode="human" needs pygame: pip install "sb3-progpolicy[render]"'
            ) from error
        if self._window is None:
            pygame.init()
            Display._open += 1
            self._window = pygame.display.set_mode((frame.shape[1], frame.shape[0]))
            self._clock = pygame.time.Clock()
        pygame.event.pump()
        self._window.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            import pygame

            self._window = None
            Display._open -= 1
            if not Display._open:
                pygame.display.quit()
                pygame.quit()


INK, PAPER, WOOD = (40, 44, 52), (250, 249, 246), (164, 132, 96)
DARK_DISC, LIGHT_DISC = (36, 89, 138), (236, 152, 54)
SCALE = 2  # drawn at twice the size and averaged down, for smooth edges


def hanoi_frame(discs: Sequence[int], source: int, target: int) -> Frame:
    """Draw a tower of Hanoi; discs of the two alternating colours, the target peg marked.

    :param discs: the peg of each disc, the smallest first
    :param source: peg on which the discs started
    :param target: peg to which they go
    :return: ``(240, 480, 3)`` bytes
    """
    from PIL import Image, ImageDraw

    width, height = 480, 240
    image = Image.new("RGB", (width * SCALE, height * SCALE), PAPER)
    draw = ImageDraw.Draw(image)

    def box(left: float, top: float, right: float, bottom: float, fill: tuple[int, int, int], radius: float) -> None:
        draw.rounded_rectangle(
            (left * SCALE, top * SCALE, right * SCALE, bottom * SCALE), radius=radius * SCALE, fill=fill
        )

    floor, centres = 204, (84, 240, 396)
    thickness = min(20, 144 // max(len(discs), 6))
    for peg, centre in enumerate(centres):
        box(centre - 4, floor - 164, centre + 4, floor, WOOD, 3)
        label = {source: "source", target: "target"}.get(peg, "")
        draw.text(
            (centre * SCALE, (floor + 24) * SCALE),
            f"{peg} {label}".strip(),
            fill=INK,
            anchor="mm",
            font_size=14 * SCALE,
        )
    box(12, floor, width - 12, floor + 8, WOOD, 3)
    for peg, centre in enumerate(centres):
        level = floor
        for disc in reversed([disc for disc, at in enumerate(discs) if at == peg]):
            half = 14 + 56 * (disc + 1) / len(discs)
            box(centre - half, level - thickness + 1, centre + half, level, LIGHT_DISC if disc % 2 else DARK_DISC, 5)
            level -= thickness
    return np.array(image.resize((width, height), Image.Resampling.LANCZOS))


SAND, GRASS, STONE, STONE_LIGHT = (232, 214, 170), (126, 160, 98), (112, 112, 116), (150, 150, 154)
LAKE, RIPPLE, STAR, STAR_EDGE = (78, 146, 204), (160, 204, 236), (250, 196, 32), (176, 120, 8)
JACKET, SKIN, BACKPACK = (200, 52, 44), (240, 196, 160), (60, 76, 120)
Place = tuple[int, int]


def hiking_frame(rows: Sequence[str], hiker: Place, stars: Sequence[Place], n_stars: int) -> Frame:
    """Draw a map with its pathways, rocks and water, the hiker and the stars that are left.

    :param rows: texts of equal length: ``#`` rock, ``~`` water, anything else pathway
    :param hiker: row and column
    :param stars: rows and columns of the stars that are left
    :param n_stars: how many stars there were; the collected ones are counted below the map
    :return: ``(412, 480, 3)`` bytes
    """
    from PIL import Image, ImageDraw

    cell, footer = 48, 28
    width, height = cell * len(rows[0]), cell * len(rows) + footer
    image = Image.new("RGB", (width * SCALE, height * SCALE), PAPER)
    draw = ImageDraw.Draw(image)
    for row, text in enumerate(rows):
        for column, kind in enumerate(text):
            _draw_ground(draw, column * cell * SCALE, row * cell * SCALE, cell * SCALE, kind)
    for row, column in stars:
        _draw_star(draw, (column + 0.5) * cell * SCALE, (row + 0.5) * cell * SCALE, 0.36 * cell * SCALE)
    _draw_hiker(draw, hiker[1] * cell * SCALE, hiker[0] * cell * SCALE, cell * SCALE)
    _draw_star(draw, 18 * SCALE, (height - footer / 2) * SCALE, 10 * SCALE)
    label = f"{n_stars - len(stars)} of {n_stars} collected"
    draw.text((36 * SCALE, (height - footer / 2) * SCALE), label, fill=INK, anchor="lm", font_size=14 * SCALE)
    return np.array(image.resize((width, height), Image.Resampling.LANCZOS))


def _draw_ground(draw: Any, left: float, top: float, size: float, kind: str) -> None:
    def at(*points: tuple[float, float]) -> list[tuple[float, float]]:
        return [(left + x * size, top + y * size) for x, y in points]

    if kind == "#":
        draw.rectangle(at((0, 0), (1, 1)), fill=GRASS)
        draw.polygon(at((0.1, 0.85), (0.18, 0.4), (0.45, 0.14), (0.78, 0.32), (0.9, 0.85)), fill=STONE)
        draw.polygon(at((0.18, 0.4), (0.45, 0.14), (0.52, 0.42), (0.3, 0.56)), fill=STONE_LIGHT)
    elif kind == "~":
        draw.rectangle(at((0, 0), (1, 1)), fill=LAKE)
        for x, y in ((0.12, 0.3), (0.5, 0.58), (0.14, 0.84)):
            draw.arc(at((x, y - 0.08), (x + 0.2, y + 0.08)), 0, 180, fill=RIPPLE, width=int(size * 0.04))
            draw.arc(at((x + 0.18, y - 0.08), (x + 0.38, y + 0.08)), 180, 360, fill=RIPPLE, width=int(size * 0.04))
    else:
        draw.rectangle(at((0, 0), (1, 1)), fill=SAND)


def _draw_star(draw: Any, x: float, y: float, radius: float) -> None:
    angles = -np.pi / 2 + np.arange(10) * np.pi / 5
    reach = radius * np.where(np.arange(10) % 2, 0.42, 1.0)
    points = [(x + r * np.cos(a), y + r * np.sin(a)) for r, a in zip(reach, angles, strict=True)]
    draw.polygon(points, fill=STAR, outline=STAR_EDGE, width=max(1, int(radius * 0.1)))


def _draw_hiker(draw: Any, left: float, top: float, size: float) -> None:
    def at(*points: tuple[float, float]) -> list[tuple[float, float]]:
        return [(left + x * size, top + y * size) for x, y in points]

    stroke = int(0.07 * size)
    draw.line(at((0.8, 0.3), (0.74, 0.92)), fill=WOOD, width=stroke // 2)
    draw.line(at((0.47, 0.62), (0.36, 0.92)), fill=INK, width=stroke)
    draw.line(at((0.52, 0.62), (0.62, 0.92)), fill=INK, width=stroke)
    draw.rounded_rectangle(at((0.24, 0.34), (0.42, 0.64)), radius=0.05 * size, fill=BACKPACK)
    draw.rounded_rectangle(at((0.38, 0.32), (0.6, 0.66)), radius=0.06 * size, fill=JACKET)
    draw.line(at((0.55, 0.42), (0.78, 0.5)), fill=JACKET, width=stroke)
    draw.ellipse(at((0.38, 0.08), (0.62, 0.32)), fill=SKIN)
    draw.pieslice(at((0.36, 0.04), (0.64, 0.32)), 180, 360, fill=INK)


TABLE, TABLE_LINE, STEEL = (222, 196, 160), (190, 160, 122), (70, 76, 88)
PLATES = (
    (178, 34, 52),
    (226, 112, 38),
    (240, 186, 40),
    (106, 168, 60),
    (40, 150, 140),
    (48, 116, 190),
    (98, 78, 170),
    (160, 70, 140),
)


def stacking_frame(n_side: int, plates: Sequence[Place], n_plates: int, gripper: Place) -> Frame:
    """Draw the table from above with its plates and the gripper, and the stack from the side.

    :param n_side: cells along a side of the table
    :param plates: rows and columns of the plates on the table, the largest first
    :param n_plates: how many plates there were; the others are on the stack
    :param gripper: row and column
    :return: ``(352, 480, 3)`` bytes
    """
    from PIL import Image, ImageDraw

    width, height, cell, edge = 480, 352, 60, 14
    image = Image.new("RGB", (width * SCALE, height * SCALE), PAPER)
    draw = ImageDraw.Draw(image)

    def at(*points: tuple[float, float]) -> list[tuple[float, float]]:
        return [(x * SCALE, y * SCALE) for x, y in points]

    def label(x: float, y: float, text: str, fill: tuple[int, int, int], size: int) -> None:
        draw.text((x * SCALE, y * SCALE), text, fill=fill, anchor="mm", font_size=size * SCALE)

    side = n_side * cell
    draw.rounded_rectangle(at((edge - 6, edge - 6), (edge + side + 6, edge + side + 6)), 8 * SCALE, fill=WOOD)
    draw.rectangle(at((edge, edge), (edge + side, edge + side)), fill=TABLE)
    for line in range(n_side + 1):
        draw.line(at((edge + line * cell, edge), (edge + line * cell, edge + side)), fill=TABLE_LINE, width=SCALE)
        draw.line(at((edge, edge + line * cell), (edge + side, edge + line * cell)), fill=TABLE_LINE, width=SCALE)
    for rank, (row, column) in enumerate(plates):
        size = len(plates) - rank
        x, y, radius = edge + (column + 0.5) * cell, edge + (row + 0.5) * cell, 9 + 19 * size / n_plates
        colour = PLATES[n_plates - size]
        draw.ellipse(at((x - radius, y - radius), (x + radius, y + radius)), fill=colour)
        draw.ellipse(
            at((x - 0.7 * radius, y - 0.7 * radius), (x + 0.7 * radius, y + 0.7 * radius)), outline=PAPER, width=SCALE
        )
        label(x, y, str(size), PAPER, 13)
    x, y = edge + (gripper[1] + 0.5) * cell, edge + (gripper[0] + 0.5) * cell
    for sign in (-1, 1):
        draw.line(at((x + sign * 20, y - 27), (x + sign * 27, y - 27), (x + sign * 27, y + 27)), fill=STEEL, width=9)
        draw.line(at((x + sign * 27, y + 27), (x + sign * 20, y + 27)), fill=STEEL, width=9)
    label(edge + side / 2, height - 16, "table and gripper", INK, 14)
    middle, level = 400, edge + side
    draw.rounded_rectangle(at((middle - 64, level - 2), (middle + 64, level + 6)), 3 * SCALE, fill=WOOD)
    for slot in range(n_plates - len(plates)):
        half = 14 + 44 * (n_plates - slot) / n_plates
        top = level - 26 * (slot + 1) - 2
        draw.rounded_rectangle(at((middle - half, top), (middle + half, top + 24)), 7 * SCALE, fill=PLATES[slot])
        label(middle, top + 12, str(n_plates - slot), PAPER, 13)
    label(middle, height - 16, "stack", INK, 14)
    return np.array(image.resize((width, height), Image.Resampling.LANCZOS))

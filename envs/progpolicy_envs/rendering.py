"""Pictures of the planning domains, drawn with Pillow, and the window that shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]


class Display:
    """A pygame window that opens with the first frame.

    :param fps: frames per second at which :meth:`show` paces itself
    """

    def __init__(self, fps: int) -> None:
        self.fps = fps
        self._window: Any = None
        self._clock: Any = None

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

            pygame.display.quit()
            pygame.quit()
            self._window = None


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
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))

"""A window that shows pictures, by pygame."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import CirlError


class Window:
    """A pygame window of fixed size; it opens with the first picture."""

    def __init__(self, caption: str) -> None:
        """Check that pygame is there.

        Raises:
            CirlError: if pygame is not installed.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame greets on stdout otherwise
        try:
            import pygame
        except ImportError as missing:
            raise CirlError(
                "render_mode 'human' needs pygame: install the extra, pip install 'cirl-marl[human]'"
            ) from missing
        self._pygame = pygame
        self._caption = caption
        self._screen: pygame.Surface | None = None

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show an image, shape (height, width, 3)."""
        if self._screen is None:
            self._pygame.display.init()
            self._screen = self._pygame.display.set_mode((image.shape[1], image.shape[0]))
            self._pygame.display.set_caption(self._caption)
        self._pygame.event.pump()
        self._pygame.surfarray.blit_array(self._screen, image.swapaxes(0, 1))
        self._pygame.display.flip()

    def close(self) -> None:
        """Close the window; it opens again with the next picture."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None

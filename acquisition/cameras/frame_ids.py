"""Frame counters that wrap, made to grow for ever."""

from __future__ import annotations

_BLOCK_IDS = 65535  # GigE Vision 1: 16 bits, and 0 is not a frame


class FrameIds:
    """Unwraps the block ids of one acquisition.

    A 16-bit counter runs 1 ... 65535, 1 ...; the 64-bit counter of GigE Vision 2's extended ids never wraps.
    A step of more than half a turn reads as a step back: the ids are right while no gap reaches 32767 frames.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._unwrapped: int | None = None

    def resume(self) -> None:
        """The camera counts anew; its first id will follow the last one so far."""
        self._last = None

    def unwrap(self, block_id: int) -> int:
        """The id, continued; the very first one as it is."""
        if self._last is None or self._unwrapped is None:
            self._unwrapped = block_id if self._unwrapped is None else self._unwrapped + 1
        else:
            step = block_id - self._last
            if max(block_id, self._last) <= _BLOCK_IDS:
                half = _BLOCK_IDS // 2
                step = (step + half) % _BLOCK_IDS - half
            self._unwrapped += step
        self._last = block_id
        return self._unwrapped

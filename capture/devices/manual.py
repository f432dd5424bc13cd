"""A lamp that nobody here controls: `manual:`, or one that blinks by itself: `manual:period=1;on=0.1`.

A person switches it by hand, or it is a phone whose camera program flashes its own torch. There is no line
to it: `start` says what to do, `poll` knows of no edge, `off` asks the person. Which frames are lit is told
by the frames alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from capture.devices.bench import Bench
from capture.devices.flash import (
    LONGEST_ON_S,
    SHORTEST_PERIOD_S,
    FlashCapabilities,
    FlashEdge,
    FlashInfo,
    PulseTrain,
)
from capture.devices.url_options import parse_options
from capture.errors import FlashError

_log = logging.getLogger(__name__)

_OPTIONS = {"period": float, "on": float}


def open_flash(rest: str, bench: Bench) -> ManualFlash:
    """The lamp of `manual:REST`.

    period=1  it blinks by itself, once in so many seconds
    on=0.1    and is lit for so long

    Raises:
        FlashError: A setting is not understood, or it would blink in a way that is not safe to look at.
    """
    options = parse_options(rest, _OPTIONS, FlashError, scheme="manual")
    return ManualFlash(period_s=options.get("period"), on_s=options.get("on"))


def list_flashes() -> list[str]:
    """None: nobody can see from here whether there is one."""
    return []


class ManualFlash:
    """A lamp in somebody's hand."""

    def __init__(
        self,
        *,
        period_s: float | None = None,
        on_s: float | None = None,
        tell: Callable[[str], None] = _log.warning,
    ) -> None:
        """Nothing happens.

        Args:
            period_s: From flash to flash where the lamp blinks by itself; None = a person switches it.
            on_s: How long each is, with `period_s`.
            tell: Is given the sentences for the person.

        Raises:
            FlashError: It would blink in a way that is not safe to look at.
        """
        if (period_s is None) != (on_s is None):
            raise FlashError("period and on go together: manual:period=1;on=0.1.")
        if period_s is not None and on_s is not None:
            if not SHORTEST_PERIOD_S <= period_s < float("inf"):
                raise FlashError(
                    f"period is {period_s} s; a light may not flash more often than three times a second "
                    f"({SHORTEST_PERIOD_S} s)."
                )
            if not 0 < on_s <= LONGEST_ON_S or not on_s < period_s:
                raise FlashError(f"on is {on_s} s; a flash lasts at most {LONGEST_ON_S} s.")
        self._period_s, self._on_s = period_s, on_s
        self._tell = tell
        self._running = False

    @property
    def info(self) -> FlashInfo:
        """Who it is."""
        rest = "" if self._period_s is None else f"period={self._period_s:g};on={self._on_s:g}"
        return FlashInfo(
            url=f"manual:{rest}",
            name="a lamp switched by hand" if self._period_s is None else "a lamp that blinks by itself",
            back_end="manual",
            details={"period_s": self._period_s, "on_s": self._on_s},
        )

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do: nothing that could be relied upon."""
        return FlashCapabilities(
            own_schedule=self._period_s is not None, watchdog=False, shortest_on_s=self._on_s or 0.0
        )

    def start(self, train: PulseTrain) -> None:
        """Says what is to be done."""
        self._running = True
        if self._period_s is not None:
            self._tell(
                f"Let the lamp blink now, every {self._period_s:g} s for {self._on_s:g} s; it is not "
                "controlled from here."
            )
        else:
            self._tell(
                f"Switch the lamp on for {train.on_s:.2g} s every {train.period_s:.3g} s, "
                f"{train.count} times; it is not controlled from here."
            )

    def poll(self) -> tuple[FlashEdge, ...]:
        """No edge is ever known."""
        return ()

    def off(self) -> bool:
        """Asks the person, once a train; nobody confirms it."""
        if self._running:
            self._running = False
            self._tell("Switch the lamp off.")
        return False

    def link_report(self) -> dict[str, Any]:
        """Empty: there is no link."""
        return {}

    def close(self) -> None:
        """Asks the person to switch it off, should a train run."""
        self.off()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()

"""The charts of a source, by the light that they are in.

A session or a folder of pairs (`calib.flash.pairs`) tells both lights: what the flash adds, and the room's.
Other pictures are in the one light that is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.colour.chart import ChartProblem, ChartReading, difference, find_chart, moved, read_chart
from calib.errors import ColourError
from calib.flash.pairs import FlashPair, LinearPicture

#: The lights that a chart can be in.
LIGHTS = ("flash", "room")
_ENOUGH = 12  # pairs: more tell nothing new, and each takes a second


@dataclass
class ChartLights:
    """Charts found.

    Attributes:
        flash: under what the flash adds.
        room: under the room's light.
        pictures: how many were searched.
        refused: how many tell nothing, and why.
        dark_room: pairs whose room is too dark to tell its colour.
    """

    flash: list[ChartReading] = field(default_factory=list)
    room: list[ChartReading] = field(default_factory=list)
    pictures: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    dark_room: int = 0

    def describe(self) -> str:
        """One line for people."""
        parts = [
            f"{self.pictures} pictures",
            f"{len(self.flash)} under the flash, {len(self.room)} in the room",
        ]
        parts += [f"{count} where {why}" for why, count in self.refused.most_common()]
        return ", ".join(parts)

    def check(self) -> None:
        """Refuses what tells nothing.

        Raises:
            ColourError: no chart was read.
        """
        if not self.flash and not self.room:
            why = self.refused.most_common(1)[0][0] if self.refused else "there are no pictures"
            raise ColourError(f"No picture tells the chart's colours: {why} (in {self.pictures} looked at).")


def charts_of_pairs(pairs: Iterable[FlashPair], flat_field: NDArray[np.float64] | None) -> ChartLights:
    """The charts of pairs with and without the flash.

    Args:
        pairs: one after the other; the first dozen that tell are used.
        flat_field: [n] as in `calib.calibration`; None or empty = the lens passes all.
    """
    found = ChartLights()
    for pair in pairs:
        found.pictures += 1
        problem = _read_pair(pair, flat_field, found)
        if problem is not None:
            found.refused[problem.value] += 1
        if len(found.flash) >= _ENOUGH:
            break
    return found


def charts_of_pictures(
    pictures: Iterable[LinearPicture], light: str, flat_field: NDArray[np.float64] | None
) -> ChartLights:
    """The charts of pictures that are all in one light, a name of `LIGHTS`."""
    found = ChartLights()
    for picture in pictures:
        found.pictures += 1
        corners = find_chart(picture)
        read = corners if isinstance(corners, ChartProblem) else read_chart(picture, corners, flat_field)
        if isinstance(read, ChartReading) and read.dark:
            read = ChartProblem.DARK
        if isinstance(read, ChartProblem):
            found.refused[read.value] += 1
        else:
            (found.flash if light == "flash" else found.room).append(read)
    return found


def _read_pair(
    pair: FlashPair, flat_field: NDArray[np.float64] | None, found: ChartLights
) -> ChartProblem | None:
    """Adds what a pair tells, or says why it tells nothing."""
    corners = find_chart(pair.lit)
    if isinstance(corners, ChartProblem):
        return corners
    before = find_chart(pair.unlit)
    if not isinstance(before, ChartProblem) and moved(corners, before):
        return ChartProblem.MOVED
    lit = read_chart(pair.lit, corners, flat_field)
    if isinstance(lit, ChartProblem):
        return lit
    unlit = read_chart(pair.unlit, corners, flat_field)
    if isinstance(unlit, ChartProblem):
        return unlit
    added = difference(lit, unlit)
    if added.dark:
        return ChartProblem.DARK
    found.flash.append(added)
    if unlit.dark:
        found.dark_room += 1
    else:
        found.room.append(unlit)
    return None

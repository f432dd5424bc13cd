"""From pictures to the views that a calibration is made of, and why there are too few where there are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board
from calib.board.detection import BoardDetector, BoardView, Problem
from calib.board.pictures import Picture
from calib.errors import IntrinsicsError
from calib.lens.checks import FEWEST_VIEWS
from calib.lens.view_selection import ViewShelf

Progress = Callable[[str, float], None]

_EXAMINED = 3  # refused pictures kept for a closer look, those with the most that could be markers
_LAYOUT_WORDS = {
    "current": "layout of OpenCV since 4.6",
    "legacy": "legacy layout (before OpenCV 4.6, calib.io)",
    "both": "layout that is the same before and since OpenCV 4.6",
}
_ADVICE = {
    Problem.NO_BOARD: "fill half of the picture with the board, lit evenly and without reflections, and "
    "check that it is the board described",
    Problem.PARTIAL: "show more of the board, and nearer",
    Problem.BLURRED: "lock the focus on the board, give more light and hold still",
    Problem.MIRRORED: "switch the mirroring of the camera app off, as selfie cameras have it, or flip the "
    "pictures",
    Problem.OTHER_BOARD: "give the description of the board that was filmed (squares, markers, dictionary)",
    Problem.OTHER_MARKERS: "give the dictionary of the board that was filmed",
}


@dataclass
class CollectedViews:
    """What came of the pictures.

    Attributes:
        views: those kept.
        searched: number of pictures.
        problems: how many gave no view, by reason.
        repeated: how many showed a pose that was seen already.
        layouts: how many views were found in each layout.
    """

    views: list[BoardView]
    searched: int = 0
    problems: Counter[Problem] = field(default_factory=Counter)
    repeated: int = 0
    layouts: Counter[str] = field(default_factory=Counter)

    def describe(self) -> str:
        """One line for people."""
        parts = [f"{self.searched} pictures searched", f"{len(self.views)} views used"]
        if self.repeated:
            parts.append(f"{self.repeated} of a pose that was seen already")
        parts += [f"{count} in the {_LAYOUT_WORDS[name]}" for name, count in self.layouts.most_common()]
        parts += [f"{count} where {problem.value}" for problem, count in self.problems.most_common()]
        return ", ".join(parts)


def collect_views(
    pictures: Iterable[Picture],
    board: Board,
    capacity: int = 60,
    progress: Progress = lambda stage, fraction: None,
) -> CollectedViews:
    """The best views of a board in pictures, which come one at a time and are not kept.

    Raises:
        IntrinsicsError: too few; the message says what is wrong with most of them.
    """
    detector = BoardDetector(board)
    shelf = ViewShelf(board, max(capacity, FEWEST_VIEWS))
    collected = CollectedViews([])
    refused: list[tuple[int, Problem, str, NDArray[np.uint8]]] = []
    for picture in pictures:
        result = detector.look(picture.grey, picture.name)
        collected.searched += 1
        if isinstance(result, BoardView):
            shelf.add(result)
            collected.layouts[result.layout] += 1
        else:
            collected.problems[result.problem] += 1
            refused.append((result.candidates, result.problem, picture.name, picture.grey))
            refused.sort(key=lambda entry: -entry[0])
            del refused[_EXAMINED:]
        progress("look for the board", picture.fraction)
    collected.views, collected.repeated = shelf.views, shelf.repeated
    if len(collected.views) < FEWEST_VIEWS:
        raise _too_few(collected, detector, [(name, grey) for _, _, name, grey in refused])
    return collected


def _too_few(
    collected: CollectedViews, detector: BoardDetector, refused: list[tuple[str, NDArray[np.uint8]]]
) -> IntrinsicsError:
    head = (
        f"{len(collected.views)} of {collected.searched} pictures give a view of the board from a place of "
        "its "
        f"own; at least {FEWEST_VIEWS} are needed"
    )
    if collected.repeated > sum(collected.problems.values()):
        return IntrinsicsError(
            f"{head}. {collected.repeated} show it where it was seen already: move and tilt it between the "
            "pictures, or film it while you do."
        )
    if not refused:
        return IntrinsicsError(f"{head}. Take more: near and far, tilted to all sides, in all corners.")
    diagnoses: list[tuple[str, Problem, str]] = []
    kinds: Counter[Problem] = Counter()
    for name, grey in refused:
        diagnoses.append((name, *detector.diagnose(grey)))
        kinds[diagnoses[-1][1]] += 1
        if max(kinds.values()) == 2:
            break
    common = kinds.most_common(1)[0][0]
    name, _, detail = next(entry for entry in diagnoses if entry[1] is common)
    count = sum(collected.problems.values())
    what = (
        f"In {name} {common.value}{detail} ({count} such pictures)"
        if count == 1
        else (f"In {count} of them no usable board was found; in {name}, {common.value}{detail}")
    )
    return IntrinsicsError(
        f"{head}. {what}: {_ADVICE[common]}. The board asked for: {detector.board.describe()}."
    )

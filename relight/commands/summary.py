"""What is in a session, in a few lines for a person."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from capture.frame_record import EXCLUDING_REASONS
from capture.session import Session


def describe_session(session: Session) -> str:
    """Frames by what they are good for, what else the session has, and what to do next."""
    frames = session.frames
    usable = [record for record in frames if record.usable]
    lit = sum(record.flash == 1 for record in usable)
    excluded = Counter(
        next((reason for reason in record.reasons if reason in EXCLUDING_REASONS), "flash_unknown")
        for record in frames
        if not record.usable
    )
    image = session.info["image"]
    size = f"{image['width']} x {image['height']} pixels, {image['transfer']}"
    lines = [
        f"session   {session.path}",
        f"frames    {len(frames)} looked at, {size}",
        f"usable    {len(usable)}: {lit} lit, {len(usable) - lit} unlit",
    ]
    if excluded:
        counts = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in excluded.most_common())
        lines.append(f"not used  {counts}")
    lines += [
        f"poses     {_word(session.cameras_dir)}",
        f"cloud     {_word(session.points_path)}",
        f"masks     {_word(session.masks_dir)}",
        *(f"note      {sentence}" for sentence in [*session.info.get("warnings", []), *session.repairs]),
        f"next      relight plan {session.path}",
    ]
    return "\n".join(lines)


def describe_geometry(session: Session) -> list[str]:
    """What was found from the frames, a line each; nothing where all was given."""
    from relight.stage_cache import StageCache

    cache = StageCache(session)
    lines = []
    for stage, record in ((stage, cache.record(stage)) for stage in ("poses", "cloud", "masks", "scale")):
        if record is None:
            continue
        facts = ", ".join(
            f"{name.replace('_', ' ')} {value:.4g}"
            if isinstance(value, float)
            else f"{name.replace('_', ' ')} {value}"
            for name, value in record.report.items()
            if isinstance(value, (int, float, str)) and not isinstance(value, bool)
        )
        lines.append(f"{stage:<9} {facts}")
        lines += [f"note      {sentence}" for sentence in record.warnings]
    return lines


def _word(path: Path) -> str:
    return "yes" if path.exists() else "no"

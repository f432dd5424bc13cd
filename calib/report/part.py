"""What the page says of one part of a calibration, and the evidence that the part left beside it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from capture.errors import CalibrationError
from capture.json_fields import Fields, read_json

#: Verdicts, from best to worst.
GOOD, DOUBTFUL, UNKNOWN = "good", "doubtful", "not known"

NO_EVIDENCE = "what it was made from does not lie beside the calibration"


@dataclass(frozen=True)
class Part:
    """A part of the page.

    Attributes:
        name: for people.
        verdict: GOOD, DOUBTFUL or UNKNOWN.
        why: what the verdict rests on, with its limit.
        body: HTML; empty where nothing is known.
        warnings: sentences that the calibration itself left.
    """

    name: str
    verdict: str
    why: str
    body: str = ""
    warnings: list[str] = field(default_factory=list)


def judged(name: str, good: bool, why: str, body: str, warnings: list[str]) -> Part:
    """A part that is known."""
    return Part(name, GOOD if good else DOUBTFUL, why, body, warnings)


def read_evidence(path: Path, schema: str) -> Fields | None:
    """The evidence of a part; None where there is no file.

    Raises:
        CalibrationError: it is damaged, of another kind, or newer than this program.
    """
    if not path.is_file():
        return None
    evidence = read_json(path, CalibrationError)
    if evidence.text("schema", "") != schema:
        raise evidence.fail(f"the schema is {evidence.text('schema', '')!r}, not {schema!r}.")
    if evidence.integer("version", low=1) > 1:
        raise evidence.fail("it was written by a newer program; update the program.")
    return evidence


def sentences(evidence: Fields, key: str) -> list[str]:
    """A list of texts."""
    said = evidence.values.get(key) or []
    if not isinstance(said, list) or not all(isinstance(sentence, str) for sentence in said):
        raise evidence.fail(f'"{key}" must be a list of texts.')
    return list(said)

"""Names of the files that redesigns are written to; imports nothing that takes long."""

from __future__ import annotations

from collections.abc import Sequence

from mdf_core.errors import InvalidSettingError

FORMATS = ("stl", "3mf", "ply")
"""Files that a redesign can be written as."""

REDESIGN_STEM = "redesigned"
"""What the names of all these files begin with."""

REDESIGN_FILE = f"{REDESIGN_STEM}.stl"
"""STL of a redesign that was made alone."""

PRINTED_FILE = f"{REDESIGN_STEM}_before.ply"
"""The redesign that was printed, and what it rests on, as the ledger knew it."""


def redesign_stems(gains: Sequence[float]) -> list[str]:
    """Names of the files of redesigns that were made together, without ending: with the gain, if there are several.

    Raises
    ------
    InvalidSettingError
        Two gains would have the same name.
    """
    if len(gains) == 1:
        return [REDESIGN_STEM]
    stems = [f"{REDESIGN_STEM}_{gain:g}" for gain in gains]
    if len(set(stems)) < len(stems):
        raise InvalidSettingError(f"equal gains {', '.join(f'{gain:g}' for gain in gains)}", "gains", "give each once")
    return stems

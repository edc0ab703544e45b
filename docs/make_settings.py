"""Writes docs/settings.md from `mdf_core.settings`: ``python docs/make_settings.py``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from mdf_core.settings import Settings, Value, leaves

PAGE = Path(__file__).with_name("settings.md")

_INTRODUCTION = """# Settings

Written by `python docs/make_settings.py` from `mdf_core/settings.py`; a test holds the two together.

Everything that an inspection and a redesign depend on besides their input. Each setting has one name everywhere:

| where | how |
|---|---|
| command | `mdf inspect … --set surface.rank=100` (lists with commas: `--set surface.beta=1.5,1.0`) |
| library | `mdf.Settings().replace({"surface.rank": 100})` |
| node | `--ros-args -p surface.rank:=100`, `ros2 param set /registration surface.rank 100` |
| parameters file | `surface: {rank: 100}` under `/**: ros__parameters:` |

Lengths end in `_mm`. A node checks a change as a whole and uses it from its next job on. A change of any value changes
the `settings_hash` of the results. Names of unknown settings and values out of range are refused with
[INVALID_SETTING](errors.md).
"""


def page() -> str:
    """The text of docs/settings.md."""
    settings = Settings()
    sections = {"": "The whole"}
    for entry in dataclasses.fields(settings):
        branch = getattr(settings, entry.name)
        if dataclasses.is_dataclass(branch):
            sections[entry.name] = (type(branch).__doc__ or "").rstrip(".")
    lines = [_INTRODUCTION]
    for prefix, title in sections.items():
        lines += [f"## {title}", "", "| name | default | unit | range | meaning |", "|---|---|---|---|---|"]
        for name, leaf, value in leaves(settings):
            if name.rpartition(".")[0] == prefix:
                told = leaf.metadata
                cells = (f"`{name}`", _text(value), told["unit"], _range(told), told["description"])
                lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _text(value: Value) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value) or "empty"
    # YAML takes 1e-05, without a point, for a word.
    return np.format_float_positional(value, trim="-") if isinstance(value, float) else str(value)


def _range(told: dict[str, object]) -> str:
    if told["choices"]:
        return ", ".join(told["choices"])  # type: ignore[call-overload]
    if told["minimum"] is None:
        return ""
    return f"{_number(told['minimum'])} … {_number(told['maximum'])}"


def _number(value: object) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


if __name__ == "__main__":
    PAGE.write_text(page())

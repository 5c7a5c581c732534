"""Docstrings of this project as Markdown, for the API reference: their aligned columns become lists, examples become code.

An extension of Griffe, which mkdocstrings reads the sources with; zensical.toml names it.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_HEADING = re.compile(r"^(\w+)\n-{3,}$", re.MULTILINE)
_ENTRY = re.compile(r"^(\w[\w, ]*?)(?: {2,}|: |(?= \())(.*)$")
"""`name  what`, `name: what` and `name (shape), what`, at the left margin."""


class MarkdownDocstrings(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(docstring: str) -> str:
    """A docstring in which every paragraph of `name  what` lines is a list."""
    text = _HEADING.sub(r"**\1**\n", docstring)
    return "\n\n".join(_paragraph(part) for part in re.split(r"\n\s*\n", text))


def _paragraph(text: str) -> str:
    lines = text.strip("\n").split("\n")
    if lines[0].lstrip().startswith(">>>"):
        return "```pycon\n" + "\n".join(lines) + "\n```"
    first = [line for line in lines if not line.startswith(" ")]
    if not all(_ENTRY.match(line) for line in first) or ("  " not in text and len(first) < 2):
        return "\n".join(line if line.startswith("    ") else line.strip() for line in lines)
    items: list[str] = []
    for line in lines:
        entry = _ENTRY.match(line)
        items.append(f"- `{entry[1]}`: {entry[2]}" if entry else f"  {line.strip()}")
    return "\n".join(items)

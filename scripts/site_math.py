"""Equations of the documentation as MathML, which browsers show without a script: $...$ in text, and ```math blocks.

An extension of Python-Markdown that zensical.toml names. A wrong equation ends the build.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree.ElementTree import Element, fromstring

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor

_NAMESPACE = ' xmlns="http://www.w3.org/1998/Math/MathML"'
_BEFORE_CODE_ENDS = 185
"""Below the priority of code in backticks, which may hold a $, and above that of escapes."""


class _Inline(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[Element, int, int]:  # type: ignore[override]
        return fromstring(convert(m.group(1)).replace(_NAMESPACE, "")), m.start(0), m.end(0)


class _Math(Extension):
    def extendMarkdown(self, md: Markdown) -> None:
        md.inlinePatterns.register(
            _Inline(r"(?<![\w$\\])\$([^\s$](?:[^$\n]*[^\s$])?)\$(?!\w)", md), "math", _BEFORE_CODE_ENDS
        )


def block(source: str, *_: Any, **__: Any) -> str:
    """The equation of a fenced block of the language `math`, as HTML."""
    return f'<div class="math">{convert(source.strip(), display="block")}</div>'


def makeExtension(**options: Any) -> Extension:
    """What Python-Markdown calls."""
    return _Math(**options)

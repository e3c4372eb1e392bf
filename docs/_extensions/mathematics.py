"""Formulas as MathML, which browsers show by themselves: nothing is loaded to see them."""

from __future__ import annotations

import re
from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError


def _in_line(translator: Any, node: nodes.math) -> None:  # noqa: ANN401 - Sphinx's translator
    translator.body.append(_convert(node.astext(), display="inline"))
    raise nodes.SkipNode


def _by_itself(translator: Any, node: nodes.math_block) -> None:  # noqa: ANN401 - likewise
    text = node.astext()
    tag = re.search(r"\\tag\{([^}]*)\}", text)
    shown = f'<span class="eqno">({escape(tag[1])})</span>' if tag else ""
    formula = _convert(text.replace(tag[0], "") if tag else text, display="block")
    translator.body.append(f'<div class="math notranslate">{shown}{formula}</div>')
    raise nodes.SkipNode


def _convert(formula: str, *, display: str) -> str:
    try:
        return str(convert(formula, display=display))
    except Exception as e:
        raise ExtensionError(f"no formula: {formula}: {type(e).__name__}: {e}") from e


def setup(app: Sphinx) -> dict[str, Any]:
    """Take over formulas."""
    app.add_html_math_renderer("mathml", (_in_line, None), (_by_itself, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}

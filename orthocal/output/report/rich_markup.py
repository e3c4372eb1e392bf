"""What is printed, as HTML: the same tables and lines, in the page's own type."""

from __future__ import annotations

from itertools import groupby

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from orthocal.io.html import items, paragraph, table

BULLET = "• "


def to_markup(content: RenderableType) -> str:
    """Rich tables, texts and groups of them as HTML, all text escaped.

    Raises:
        TypeError: For a renderable of another kind.
    """
    parts = list(_flatten(content))
    found = []
    for is_item, run in groupby(parts, key=lambda part: isinstance(part, str) and _is_item(part)):
        texts = list(run)
        if is_item:
            found.append(items(str(t).removeprefix(BULLET) for t in texts))
        else:
            found += [paragraph(t) if isinstance(t, str) else _table(t) for t in texts if t]
    return "\n".join(found)


def _flatten(content: RenderableType) -> list[str | Table]:
    if isinstance(content, Group):
        return [part for inner in content.renderables for part in _flatten(inner)]
    if isinstance(content, Padding):
        return _flatten(content.renderable)
    if isinstance(content, Text):
        return [content.plain]
    if isinstance(content, Table):
        return [content]
    raise TypeError(f"no HTML for a {type(content).__name__}")


def _is_item(text: str) -> bool:
    return text.startswith(BULLET)


def _table(content: Table) -> str:
    headers = [_plain(column.header) for column in content.columns]
    columns = [[_plain(cell) for cell in column.cells] for column in content.columns]
    left = [column.justify == "left" for column in content.columns]
    return table(
        headers, zip(*columns, strict=True), left=left.index(False) if False in left else 99
    )


def _plain(cell: RenderableType) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)

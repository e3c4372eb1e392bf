"""HTML fragments with escaped text."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence

from orthocal.text import printable

CODE = re.compile("`([^`\n]+)`")
"""Code between backquotes."""

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:"


def page(title: str, style: str, body: str, *, scripts: bool = False) -> str:
    """Self-contained page that loads nothing from other files or servers.

    Args:
        title: Title of the page.
        style: Style sheet.
        body: Content of the body, HTML.
        scripts: Whether the page, or a frame in it, may run scripts.
    """
    policy = f"{_POLICY}; script-src 'unsafe-inline'" if scripts else _POLICY
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f'<title>{escape(title)}</title>\n<link rel="icon" href="data:,">\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def escape(text: str) -> str:
    """HTML of a text, without markup and without characters that change the text direction."""
    return html.escape(printable(text, keep="\n"))


def prose(text: str) -> str:
    """HTML of a text in which words between backquotes are code."""
    return CODE.sub(r"<code>\1</code>", escape(text))


def paragraph(text: str, *, kind: str = "") -> str:
    """Paragraph of prose, with an optional class `kind`."""
    return f"<p{_class(kind)}>{prose(text)}</p>"


def heading(text: str, *, level: int = 2) -> str:
    """Heading of a level from 1 to 6."""
    return f"<h{level}>{escape(text)}</h{level}>"


def items(texts: Iterable[str]) -> str:
    """Bulleted list of prose."""
    return "<ul>" + "".join(f"<li>{prose(t)}</li>" for t in texts) + "</ul>"


def table(headers: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> str:
    """Table with columns of words and of numbers.

    Args:
        headers: Headers of the columns; all empty for a table without a header.
        rows: Cells of each row.
        left: Number of columns of words at the left; other columns contain numbers or units.
    """
    has_words = [i < left or h == "unit" for i, h in enumerate(headers)]

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{_class('' if word else 'number')}>{escape(text)}</{tag}>"
            for text, word in zip(texts, has_words, strict=True)
        )

    head = f"<thead><tr>{cells('th', headers)}</tr></thead>" if any(headers) else ""
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<table>{head}<tbody>{body}</tbody></table>"


def _class(name: str) -> str:
    return f' class="{escape(name)}"' if name else ""

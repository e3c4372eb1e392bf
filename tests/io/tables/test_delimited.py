"""Delimited text: encodings, separators, and bounds on time and memory."""

from __future__ import annotations

import tracemalloc

import pytest
from watchdog import cpu_limit

from orthocal.errors import SessionError
from orthocal.io.tables import delimited
from orthocal.io.tables.cell import MOST_COLUMNS
from orthocal.io.tables.delimited import (
    LARGEST_TEXT,
    LONGEST_ROW,
    decode,
    find_separator,
    split_rows,
)

MEGABYTE = 2**20

ROWS, CELLS = 2_000, 5_000
"""Bounds in place of those of the module, for short tests."""


def find_first(rows):
    return 0 if rows and len(rows[0].cells) == 2 else None


def rows_of(text, separator="comma"):
    return [
        (row.line, [c.text for c in row.cells]) for row in split_rows(text, separator, where="t")
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a,b\n\n,,\nc\n", [(1, ["a", "b"]), (4, ["c"])]),
        ('"a\nb",c\nd', [(2, ["a\nb", "c"]), (3, ["d"])]),
        ("sep=,\na,b\n", [(2, ["a", "b"])]),
        ("a, b,\n", [(1, ["a", "b"])]),
    ],
)
def test_rows_have_their_line_numbers(text, expected):
    assert rows_of(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("," * (LONGEST_ROW + 1), f"t:1: the row has more than {LONGEST_ROW} characters"),
        ('a\n"' + "b\n" * LONGEST_ROW, "t:65537: the row has more than"),
        ('"\n",' * LONGEST_ROW, "t:"),
        ("," * MOST_COLUMNS, f"t:1: has {MOST_COLUMNS + 1} columns"),
        ("a\n" * (ROWS + 1), f"t: has more than {ROWS} rows"),
        (("," * 499 + "a\n") * (CELLS // 500 + 1), f"t: has more than {CELLS} cells"),
        ('a,"b', "t:1: is not valid CSV"),
    ],
    ids=["row", "open-quote", "row-of-many-lines", "columns", "rows", "cells", "quote"],
)
def test_tables_that_are_too_large(text, message, monkeypatch):
    monkeypatch.setattr(delimited, "MOST_CELLS", CELLS)
    monkeypatch.setattr(delimited, "MOST_ROWS", ROWS)
    with cpu_limit(), pytest.raises(SessionError) as caught:
        rows_of(text)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    "text", ["," * 10, ",,,\n" * 3, '"\n",' * 3], ids=["row", "rows", "quotes"]
)
def test_memory_is_bounded_by_what_is_accepted(text, monkeypatch):
    """Ten megabytes of commas took 170 MB."""
    monkeypatch.setattr(delimited, "MOST_ROWS", 1_000)
    text *= 10 * MEGABYTE // len(text)
    tracemalloc.start()
    try:
        with pytest.raises(SessionError):
            list(split_rows(text, "comma", where="t"))
        assert tracemalloc.get_traced_memory()[1] < 8 * MEGABYTE
    finally:
        tracemalloc.stop()


def test_a_large_file_is_not_decoded():
    with pytest.raises(SessionError, match=r"^t: has 16\.0 MiB; expected at most 16 MiB$"):
        decode(b"a" * (LARGEST_TEXT + 1), where="t")


@pytest.mark.parametrize(
    ("content", "encoding"),
    [
        (b"a,b", "utf-8"),
        ("ä".encode(), "utf-8"),
        (b"\xef\xbb\xbfa", "utf-8"),
        ("a;b".encode("utf-16"), "utf-16-le"),
        ("a;b".encode("utf-16-le"), "utf-16-le"),
        ("a;b".encode("utf-16-be"), "utf-16-be"),
        ("ab".encode("utf-32"), "utf-32"),
        (b"\xe4", "cp1252"),
    ],
)
def test_encodings_are_detected(content, encoding):
    assert decode(content, where="t").encoding == encoding


@pytest.mark.parametrize(
    ("text", "requested", "expected"),
    [
        ("a;b\n", None, "semicolon"),
        ("a\tb\n", None, "tab"),
        ("sep=|\na;b\n", None, "pipe"),
        ("a;b\n", "comma", "comma"),
        ("a;b;c,d\n", None, "comma"),
        ("a;b;c\n", None, "semicolon"),
    ],
)
def test_separators_are_detected(text, requested, expected):
    assert find_separator(text, find_first, where="t", requested=requested)[0] == expected


def test_an_ambiguous_separator_is_refused():
    with pytest.raises(SessionError, match="choose one by --separator"):
        find_separator("a;b|c\n", find_first, where="t")

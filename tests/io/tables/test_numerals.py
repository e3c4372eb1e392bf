"""Numerals: their values with either decimal sign, and the decimal sign of a table."""

from __future__ import annotations

from decimal import Decimal

import pytest

from orthocal.errors import SessionError
from orthocal.io.tables.numerals import Numeral, decide_decimal_sign, is_missing, parse_numeral

CASES = {
    # text: with a decimal point, with a decimal comma
    "0": ("0", "0"), "007": ("7", "7"), "-12": ("-12", "-12"), "+0.5": ("0.5", None),
    "0,5": (None, "0.5"), ".5": ("0.5", None), ",5": (None, "0.5"), "5.": ("5", None),
    "5,": (None, "5"), "1,234": ("1234", "1.234"), "1.234": ("1.234", "1234"),
    "0.123": ("0.123", None), "0,123": (None, "0.123"), "12,34": (None, "12.34"),
    "1234,567": (None, "1234.567"), "1,2345": (None, "1.2345"), "1,234,567": ("1234567", None),
    "1.234.567,8": (None, "1234567.8"), "1,234.5": ("1234.5", None), "1 234,5": (None, "1234.5"),
    "1\u00a0234.5": ("1234.5", None), "1'234.5": ("1234.5", None), "12 34": (None, None),
    "1 234'567": (None, None), "−0,43": (None, "-0.43"), "– 0.43": ("-0.43", None),
    "'0.43": ("0.43", None), "\u200e0.43\u200b": ("0.43", None), "1e-3": ("0.001", "0.001"),
    "1,5E-03": (None, "0.0015"), "—0.5": (None, None), "--1": (None, None), "(1)": (None, None),
    "1-": (None, None), "0x10": (None, None), "1_0": (None, None), "٣": (None, None),
    "²": (None, None), "nan": (None, None), "inf": (None, None), "1e": (None, None),
    "1e9999": (None, None), ".": (None, None), ",": (None, None), "": (None, None),
    "9" * 101: (None, None),
}  # fmt: skip


@pytest.mark.parametrize("text", CASES)
def test_value_with_either_decimal_sign(text):
    values = [parse_numeral(text, sign) for sign in ("point", "comma")]
    assert values == [None if v is None else Decimal(v) for v in CASES[text]]


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["1", "0,5", "1,234"], ("comma", "0,5", None)),
        (["1,234", "0.5"], ("point", "0.5", None)),
        (["1", "2"], ("point", None, None)),
        (["1", "1,234"], (None, None, "1,234")),
        (["0,5", "0.5"], (None, "0,5", "0.5")),
        (["0.5", "0,5"], (None, "0.5", "0,5")),
        (["0.5", "0,6", "0,7"], (None, "0,6", "0.5")),
        (["gut", "0,5"], ("comma", "0,5", None)),
        ([], ("point", None, None)),
    ],
)
def test_decimal_sign_of_a_table(texts, expected):
    sign, evidence, rival = expected
    numerals = [Numeral(text, at) for at, text in enumerate(texts)]
    options = {"standard": False, "advice": "state it", "place": texts.__getitem__}
    if sign is not None:
        decided = decide_decimal_sign(numerals, **options)
        assert (decided.sign, decided.evidence and decided.evidence.text) == (sign, evidence)
        return
    with pytest.raises(SessionError, match=evidence or "state it") as raised:
        decide_decimal_sign(numerals, **options)
    assert raised.value.where == rival


@pytest.mark.parametrize("text", ["", " ", "-", "–", "---", "n/a", "#N/A", "NaN", "k.A.", "…"])
def test_missing_readings(text):
    assert is_missing(text)


@pytest.mark.parametrize("text", ["0", "-0", "–1", "#DIV/0!", "x", "1-"])
def test_readings_that_are_not_missing(text):
    assert not is_missing(text)

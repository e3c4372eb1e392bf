"""Documents are read alike by both parsers, or left to the one that is slow and exact."""

from __future__ import annotations

import random

import pytest
import yaml
from fuzzing import DIAL, ERRORS, PLAN, SESSION

from orthocal.io import strict_yaml
from orthocal.io.strict_yaml import StrictLoader, load_yaml

FOREIGN = 'title: "a \\u00e9 – 机器"\nkeys: [~, yes, 1e3]\n'

DOCUMENTS = (SESSION, SESSION + PLAN, ERRORS, DIAL, FOREIGN)

LETTERS = "abc:-?,[]{}#&*!|>'\"%@` \n\t\\~0123\x85\u2028\xa0\ufeff\x07\x00é机\r"

STRANGE = (*LETTERS, "\ud800", ": ", "<<")


def read(load, text):
    """Its value in full, or why there is none."""
    try:
        return repr(load(text))
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        return f"{type(e).__name__}: {e}"


def spoil(rng, text):
    """One to three characters changed, put in or taken out."""
    letters = list(text)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(letters))
        letters[at : at + rng.randrange(2)] = rng.choice(([], [rng.choice(STRANGE)]))
    return "".join(letters)


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="PyYAML was built without libyaml")
def test_the_swift_parser_takes_what_is_good(monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(strict_yaml.StrictLoader, "__init__", refuse)
    for text in DOCUMENTS:
        assert load_yaml(text)


def test_spoilt_documents_are_read_as_the_exact_parser_reads_them():
    rng, good = random.Random(3), 0
    for _ in range(600):
        text = spoil(rng, rng.choice(DOCUMENTS))
        exactly = read(lambda text: yaml.load(text, Loader=StrictLoader), text)
        assert read(load_yaml, text) == exactly
        good += exactly.startswith("{")
    assert 200 < good < 500


def test_without_libyaml_all_is_the_same(monkeypatch):
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    for text in DOCUMENTS:
        assert load_yaml(text) == yaml.load(text, Loader=StrictLoader)

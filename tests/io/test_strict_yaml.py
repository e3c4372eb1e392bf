"""YAML: invalid documents raise the stated errors, and nothing but plain data is built."""

from __future__ import annotations

import importlib
import random

import pytest
import yaml
from fuzzing import DIAL, ERRORS, PLAN, SESSION

from orthocal.errors import SessionError
from orthocal.io import documents, strict_yaml

FOREIGN = 'title: "a \\u00e9 – 机器"\nkeys: [~, yes, 1e3]\n'

DOCUMENTS = (SESSION, SESSION + PLAN, ERRORS, DIAL, FOREIGN)

LETTERS = "abc:-?,[]{}#&*!|>'\"%@` \n\t\\~0123\x85\u2028\xa0\ufeff\x07\x00é机\r"

FOREIGN_TAGS = (
    *("!!set {a, b}", "!!map [a]", "!!omap [a: 1]", "!!pairs [a: 1]", "!!binary aGVsbG8="),
    *("!!str [1]", "!!seq {a: 1}", "!!timestamp 2020-01-01", "!<x> 1", "!!map 5", "!!set [a]"),
)

STRANGE = (*LETTERS, "\ud800", ": ", "<<")


@pytest.fixture(params=["libyaml", "python"])
def load(request, monkeypatch):
    """`load_yaml` on each of PyYAML's parsers."""
    if request.param == "python":
        monkeypatch.delattr(yaml, "CSafeLoader", raising=False)
    elif not yaml.__with_libyaml__:
        pytest.skip("PyYAML was built without libyaml")
    yield importlib.reload(strict_yaml).load_yaml
    monkeypatch.undo()
    importlib.reload(strict_yaml)


def mutate(rng, text):
    """One to three characters changed, inserted or deleted."""
    letters = list(text)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(letters))
        letters[at : at + rng.randrange(2)] = rng.choice(([], [rng.choice(STRANGE)]))
    return "".join(letters)


def test_both_parsers_read_the_same(load):
    for text in DOCUMENTS:
        assert load(text) == yaml.load(text, Loader=yaml.SafeLoader)


def test_mutated_documents(load):
    rng, good = random.Random(3), 0
    for _ in range(300):
        text = mutate(rng, rng.choice(DOCUMENTS))
        try:
            good += isinstance(load(text), dict)
        except (yaml.YAMLError, ValueError, OverflowError):
            continue
        except Exception as e:
            pytest.fail(f"{text!r}: {e!r}")
    assert 100 < good < 250


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: 1\na: 2", "the key 'a' occurs twice"),
        ("{e\u0301: 1, \u00e9: 2}", "occurs twice"),
        ("a: &b 1\nc: *b", "aliases"),
        ("? [1]\n: 2", "a key is a list or a mapping"),
        ("a: !!python/object:os.system 1", "tag"),
        ('a: "\\x07"', "control character"),
        (f"a: {'[' * 21}{']' * 21}", "nested more than 20 deep"),
        # the scanner of libyaml may stop before the events do
        *((f"a: {'[' * n}{']' * n}", "nest") for n in (5000, 100_000)),
        ("title: [" + "1," * 60_000 + "]", "holds more than 50000 keys and values"),
        *(
            (f"a: {form.format('9' * digits)}", "does not fit its tag !!")
            for form in ("{}", "-{}", "0x{}", "{}.5")
            for digits in (101, 4301)
        ),
        # 48, 90, 1000 and 16 for YAML
        *(
            (f"a: [80, {n}]", f"found {n}; expected")
            for n in ("060", "-060", "1:30", "1_000", "0x10")
        ),
        *(
            (f"title: {value}", "could not determine a constructor for the tag")
            for value in FOREIGN_TAGS
        ),
    ],
    ids=lambda v: v[:20],
)
def test_refused_documents(load, text, problem):
    with pytest.raises(yaml.MarkedYAMLError) as caught:
        load(text)
    assert problem in caught.value.problem
    assert len(caught.value.problem) < 500
    assert caught.value.problem_mark is not None


def test_zeros_of_decimal_numbers_are_accepted(load):
    assert load("[0, -0, 0.5, 060.0, 1.0e+03]") == [0, 0, 0.5, 60.0, 1000.0]


def test_redundant_tags_are_accepted(load):
    text = "{a: !!str 5, b: !!float 1, c: !!seq [!!int 2], d: !!map {e: ! 7}}"
    assert load(text) == {"a": "5", "b": 1.0, "c": [2], "d": {"e": 7}}


def test_large_files_are_refused_before_they_are_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr(documents, "load_yaml", None)
    path = tmp_path / "file"
    path.write_bytes(b" " * (strict_yaml.LARGEST_YAML + 1))
    with pytest.raises(SessionError, match="expected at most 1 MiB"):
        documents.read_yaml(path, error=SessionError)

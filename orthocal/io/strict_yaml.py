"""YAML that comes from strangers: text, numbers, lists and mappings, within bounds."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

from orthocal.text import composed, shorten, text_problem

LARGEST_YAML = 2**20
"""YAML files above this size are refused, [bytes]: PyYAML reads about one MiB a second."""

MOST_YAML_VALUES = 50_000
"""Keys and values of a YAML file; a posture has seven, and PyYAML reads as many in 2 s."""

DEEPEST = 20
"""Lists and mappings within each other; no document of ours has more than seven."""

LONGEST_NUMBER = 100
"""Characters of a number; a float needs 25."""

_READ_OTHERWISE = re.compile(r"[^\n\x20-\x3e\x40-\x7e\xa1-\u2027\u202a-\ud7ff\ue000-\ufdff]")
"""A question mark, blanks and ends of lines but the usual ones, and what cannot be printed: libyaml
takes them within brackets, or for the ends of lines, where PyYAML does not."""

_YAML = "tag:yaml.org,2002:"

_TAGS: dict[type[yaml.Event], frozenset[str]] = {
    yaml.ScalarEvent: frozenset(
        {"!", *(_YAML + t for t in ("str", "int", "float", "bool", "null"))}
    ),
    yaml.SequenceStartEvent: frozenset({"!", f"{_YAML}seq"}),
    yaml.MappingStartEvent: frozenset({"!", f"{_YAML}map"}),
}
"""Tags that a value of each kind may be given: those that it would have without any."""


class _Strict(Composer, SafeConstructor):
    """What makes a loader one for documents of a sane size: text, numbers, lists and mappings.

    It also refuses duplicate keys, aliases, keys that are no scalars and tags of other kinds.
    """

    _count = _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """The next node, where it is one that is meant."""
        event: Any = self.peek_event()  # type: ignore[attr-defined] # of the parser beside it
        problem = None
        if isinstance(event, yaml.AliasEvent):
            problem = "aliases (*name) are not allowed here"
        elif event.tag is not None and event.tag not in _TAGS[type(event)]:
            problem = f"could not determine a constructor for the tag '{shorten(event.tag)}'"
        self._count += 1
        if self._count > MOST_YAML_VALUES:
            problem = f"holds more than {MOST_YAML_VALUES} keys and values"
        if self._depth >= DEEPEST:
            problem = f"lists and mappings stand more than {DEEPEST} deep in each other"
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:  # noqa: ANN401 - any value
        """The value of a node."""
        try:
            if node.tag in (f"{_YAML}int", f"{_YAML}float") and len(node.value) > LONGEST_NUMBER:
                raise ValueError
            value = super().construct_object(node, deep)
        except (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError):
            tag = str(node.tag).replace(_YAML, "!!")
            raise yaml.MarkedYAMLError(
                problem=f"'{shorten(str(node.value))}' does not fit its tag {tag}",
                problem_mark=node.start_mark,
            ) from None
        problem = text_problem(value)
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The value of a mapping, each key of which stands once."""
        if not isinstance(node, yaml.MappingNode):
            raise yaml.MarkedYAMLError(
                problem="expected keys and values", problem_mark=node.start_mark
            )
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(
                    problem="a key is a list or a mapping; expected text",
                    problem_mark=key.start_mark,
                )
            if isinstance(key.value, str):
                key.value = composed(key.value)
            if key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key '{key.value}' stands twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return dict(super().construct_mapping(node, deep))


class StrictLoader(_Strict, yaml.SafeLoader):
    """PyYAML's own SafeLoader, strict: what is wrong with a document it tells best."""

    def scan_flow_scalar(self, style: str) -> Any:  # noqa: ANN401 - a token of PyYAML
        """A quoted text; its escapes are characters."""
        mark = self.get_mark()
        try:
            return super().scan_flow_scalar(style)
        except (ValueError, OverflowError):
            raise yaml.MarkedYAMLError(
                problem="an escape in a quoted text is no character", problem_mark=mark
            ) from None


def load_yaml(text: str) -> Any:  # noqa: ANN401 - any document
    """The value of a document.

    It is parsed by libyaml where PyYAML has it, in a fraction of the time. What that refuses, and
    what holds a character that it reads otherwise, is left to PyYAML's own parser, which says why.

    Raises:
        yaml.YAMLError, ValueError, RecursionError: If it is not valid.
    """
    if yaml.__with_libyaml__ and not _READ_OTHERWISE.search(text):
        try:
            return yaml.load(text, Loader=_swift_loader())
        except (yaml.YAMLError, ValueError, RecursionError):
            pass
    return yaml.load(text, Loader=StrictLoader)


@cache
def _swift_loader() -> type[Any]:
    """The same on libyaml's parser."""
    from yaml._yaml import CParser

    class SwiftLoader(_Strict, CParser, Resolver):
        def __init__(self, stream: str) -> None:
            CParser.__init__(self, stream)
            Composer.__init__(self)
            SafeConstructor.__init__(self)
            Resolver.__init__(self)

    return SwiftLoader

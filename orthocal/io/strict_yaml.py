"""YAML from untrusted sources: text, numbers, lists and mappings, within limits.

The events of a document are checked before any value is built, so that no document can exhaust
the memory or the stack.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from orthocal.text import composed, shorten, text_problem

LARGEST_YAML = 2**20
"""Largest size of a YAML file, [bytes]."""

MOST_YAML_VALUES = 50_000
"""Largest number of keys and values of a YAML file; a posture has seven."""

DEEPEST = 20
"""Largest depth of nested lists and mappings; the files of orthocal need seven."""

LONGEST_NUMBER = 100
"""Largest number of characters of a number; a float needs 25."""

_YAML = "tag:yaml.org,2002:"

_TAGS: dict[type[yaml.Event], frozenset[str]] = {
    yaml.ScalarEvent: frozenset(
        {"!", *(_YAML + t for t in ("str", "int", "float", "bool", "null"))}
    ),
    yaml.SequenceStartEvent: frozenset({"!", f"{_YAML}seq"}),
    yaml.MappingStartEvent: frozenset({"!", f"{_YAML}map"}),
}
"""Allowed explicit tags by kind of value."""

_OTHER_NOTATION = re.compile(r"[-+]?(?:0[0-9_]+|0[xb].*|[0-9]+[:_].*)")
"""Numbers of YAML that are read otherwise than they look: 060 is 48, and 1:30 is 90."""

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):  # type: ignore[misc] # either of PyYAML's safe loaders
    """Safe loader of PyYAML that also refuses duplicate keys and texts with control characters."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:  # noqa: ANN401 - any value
        """Value of a node."""
        is_number = node.tag in (f"{_YAML}int", f"{_YAML}float")
        try:
            if is_number and len(node.value) > LONGEST_NUMBER:
                raise ValueError
            value = super().construct_object(node, deep)
        except (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError):
            tag = str(node.tag).replace(_YAML, "!!")
            raise _error(f"'{shorten(str(node.value))}' does not fit its tag {tag}", node) from None
        if is_number and _OTHER_NOTATION.fullmatch(node.value):
            expected = "expected a decimal number without leading zeros, or a text in quotes"
            hint = " (a decimal comma? write a point)" if node.value.isdigit() else ""
            raise _error(f"found {shorten(node.value)}; {expected}{hint}", node)
        if problem := text_problem(value):
            raise _error(problem, node)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Value of a mapping without duplicate keys."""
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _error("a key is a list or a mapping; expected text", key)
            key.value = composed(key.value)
            if key.value in keys:
                raise _error(f"the key '{shorten(key.value)}' occurs twice", key)
            keys.add(key.value)
        return dict(super().construct_mapping(node, deep))


def load_yaml(text: str) -> Any:  # noqa: ANN401 - any document
    """Value of a document.

    Raises:
        yaml.YAMLError, ValueError, OverflowError: If the document is invalid or exceeds a limit.
    """
    _check_events(text)
    return yaml.load(text, Loader=_Loader)


def _check_events(text: str) -> None:
    """Check number, depth, aliases and tags of the values of a document.

    Raises:
        yaml.MarkedYAMLError: If a value is refused; at its place.
    """
    count = depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if not isinstance(event, yaml.NodeEvent):
            continue
        count += 1
        tag = getattr(event, "tag", None)
        if isinstance(event, yaml.AliasEvent):
            raise _error("aliases (*name) are not allowed here", event)
        if tag is not None and tag not in _TAGS[type(event)]:
            raise _error(f"could not determine a constructor for the tag '{shorten(tag)}'", event)
        if count > MOST_YAML_VALUES:
            raise _error(f"holds more than {MOST_YAML_VALUES} keys and values", event)
        if depth >= DEEPEST:
            raise _error(f"lists and mappings are nested more than {DEEPEST} deep", event)
        depth += isinstance(event, yaml.CollectionStartEvent)


def _error(problem: str, place: Any) -> yaml.MarkedYAMLError:  # noqa: ANN401 - a node or an event
    return yaml.MarkedYAMLError(problem=problem, problem_mark=place.start_mark)

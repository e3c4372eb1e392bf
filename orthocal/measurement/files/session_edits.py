"""Keys added to a session.yaml, of which comments, order and form remain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from orthocal.errors import SessionError
from orthocal.io.documents import read_yaml
from orthocal.io.files import read_file
from orthocal.text import composed


def add_readings(file: Path, name: str) -> bytes:
    """Content of a session.yaml with the key `readings` appended.

    Args:
        file: The session.yaml.
        name: Name of the readings.csv beside it.

    Raises:
        SessionError: If the key cannot be appended; says what to add.
    """
    content = read_file(file, error=SessionError)
    extended = content.rstrip() + f"\nreadings: {name}\n".encode()
    document = read_yaml(file, error=SessionError, content=content) | {"readings": name}
    if not _has_values(file, extended, document):
        raise SessionError(f"is missing; add `readings: {name}` to it", where=f"{file}: readings")
    return extended


def add_alignment(file: Path, aligned_at: Mapping[str, str]) -> bytes:
    """Content of a session.yaml in which setups state their alignment postures.

    Args:
        file: The session.yaml.
        aligned_at: Alignment posture by setup, of setups that state none yet.

    Raises:
        SessionError: If the keys cannot be inserted; says what to add.
    """
    content = read_file(file, error=SessionError)
    document = read_yaml(file, error=SessionError, content=content)
    text = content.decode()
    setups = _nodes(_nodes(yaml.compose(text, Loader=yaml.SafeLoader)).get("setups"))
    insertions = []
    for name, posture in aligned_at.items():
        setup = setups.get(name)
        if not isinstance(setup, yaml.MappingNode) or not setup.value:
            continue
        document["setups"][name]["aligned_at"] = posture
        place = setup.value[0][0].start_mark  # before the first key
        flow = yaml.safe_dump({"aligned_at": posture}, default_flow_style=True, allow_unicode=True)
        end = ", " if setup.flow_style else "\n" + " " * place.column
        insertions.append((place.index, flow.strip()[1:-1] + end))
    for index, added in sorted(insertions, reverse=True):
        text = text[:index] + added + text[index:]
    if len(insertions) < len(aligned_at) or not _has_values(file, text.encode(), document):
        name, posture = next(iter(aligned_at.items()))
        raise SessionError(
            f"is missing; add `aligned_at: {posture}` to it", where=f"{file}: setups.{name}"
        )
    return text.encode()


def _nodes(node: yaml.Node | None) -> dict[str, yaml.Node]:
    """Nodes of the values of a mapping, by key; none of another node."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    return {composed(key.value): value for key, value in pairs}


def _has_values(file: Path, content: bytes, document: Any) -> bool:  # noqa: ANN401 - any document
    """True if the content of a session.yaml is a document with these values."""
    try:
        return bool(read_yaml(file, error=SessionError, content=content) == document)
    except SessionError:
        return False

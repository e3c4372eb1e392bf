"""Documents at the door: YAML, JSON and CSV that come from strangers, and files written whole.

Nothing here knows what a robot or a session is. A reader gets the kind of error to raise, so that
every message names the file and what was found in it.
"""

from __future__ import annotations

import csv
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from orthocal.errors import OrthocalError

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

    Model = TypeVar("Model", bound=BaseModel)

LARGEST_FILE = 64 * 2**20
"""Files above this size are refused, [bytes]."""


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that also refuses duplicate keys and aliases."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(
                problem="aliases (*name) are not allowed here", problem_mark=event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen and isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(
                    problem=f"the key '{key.value}' stands twice", problem_mark=key.start_mark
                )
            if isinstance(key, yaml.ScalarNode):
                seen.add(key.value)
        return dict(super().construct_mapping(node, deep))


def read_text(path: Path, *, error: type[OrthocalError]) -> str:
    """Text of a UTF-8 file, with a byte order mark taken off.

    Raises:
        OrthocalError: Of the kind given, if the file is missing, too large or not text.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise error(
                f"has {size / 2**20:.0f} MiB; expected at most {LARGEST_FILE // 2**20} MiB",
                where=str(path),
            )
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise error("there is no such file", where=str(path)) from None
    except IsADirectoryError:
        raise error("is a folder; expected a file", where=str(path)) from None
    except UnicodeDecodeError as e:
        raise error(f"is not UTF-8 text (byte {e.start})", where=str(path)) from None
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=str(path)) from None


def read_yaml(path: Path, *, error: type[OrthocalError]) -> Any:  # noqa: ANN401 - any document
    """Content of a YAML file; duplicate keys and aliases are errors.

    Raises:
        OrthocalError: Of the kind given, naming file and line.
    """
    text = read_text(path, error=error)
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        line = "" if mark is None else f":{mark.line + 1}"
        raise error(f"is not valid YAML: {e.problem}", where=f"{path}{line}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        text = " ".join(str(e).split())
        raise error(f"is not valid YAML: {text or type(e).__name__}", where=str(path)) from None


def read_json(path: Path, *, error: type[OrthocalError]) -> Any:  # noqa: ANN401 - any document
    """Content of a JSON file.

    Raises:
        OrthocalError: Of the kind given, naming file and line.
    """
    text = read_text(path, error=error)
    try:
        return json.loads(text)
    except json.JSONDecodeError as e:
        raise error(f"is not valid JSON: {e.msg}", where=f"{path}:{e.lineno}") from None
    except (ValueError, RecursionError) as e:
        raise error(f"is not valid JSON: {e or type(e).__name__}", where=str(path)) from None


def read_csv_rows(
    path: Path,
    *,
    required: tuple[str, ...],
    optional: tuple[str, ...] = (),
    error: type[OrthocalError],
) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV file with a header, as (line number, column to text); blank lines skipped.

    Semicolons are taken as separators where the header has no comma.

    Raises:
        OrthocalError: Of the kind given, naming file and line.
    """
    text = read_text(path, error=error)
    lines = text.splitlines()
    if not lines or not lines[0].strip():
        raise error(f"is empty; expected a header: {','.join(required)}", where=f"{path}:1")
    delimiter = ";" if "," not in lines[0] and ";" in lines[0] else ","
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        header = [name.strip() for name in next(reader)]
        for name in header:
            if name not in required and name not in optional:
                raise error(
                    f"unknown column '{name}'; expected {', '.join(required)}"
                    + (f" and optionally {', '.join(optional)}" if optional else ""),
                    where=f"{path}:1",
                )
            if header.count(name) > 1:
                raise error(f"the column '{name}' stands twice", where=f"{path}:1")
        for name in required:
            if name not in header:
                raise error(
                    f"the column '{name}' is missing; found {', '.join(header)}",
                    where=f"{path}:1",
                )
        for row in reader:
            line = reader.line_num
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise error(
                    f"has {len(row)} fields; expected {len(header)} ({delimiter.join(header)})",
                    where=f"{path}:{line}",
                )
            yield line, {name: cell.strip() for name, cell in zip(header, row, strict=True)}
    except csv.Error as e:
        raise error(f"is not valid CSV: {e}", where=f"{path}:{reader.line_num}") from None


def parse_number(text: str, *, where: str, name: str, error: type[OrthocalError]) -> float:
    """A finite number from a CSV field.

    Raises:
        OrthocalError: Of the kind given, for text, NaN, infinity or a decimal comma.
    """
    try:
        value = float(text)
    except ValueError:
        hint = " (a decimal comma? write a point)" if "," in text else ""
        raise error(f"{name} is '{text}'; expected a number{hint}", where=where) from None
    if value - value != 0.0:
        raise error(f"{name} is '{text}'; expected a finite number", where=where)
    return value


def validate(
    schema: type[Model],
    data: Any,  # noqa: ANN401 - any document
    *,
    where: str,
    error: type[OrthocalError],
) -> Model:
    """Data as an instance of a pydantic schema.

    Raises:
        OrthocalError: Of the kind given, with the first key that does not fit.
    """
    from pydantic import ValidationError

    if not isinstance(data, Mapping):
        found = "nothing" if data is None else f"a {type(data).__name__}"
        raise error(f"holds {found}; expected keys and values", where=where)
    try:
        return schema.model_validate(data)
    except ValidationError as e:
        key, problem = explain_validation_error(e, schema)
        raise error(problem, where=f"{where}: {key}" if key else where) from None


def explain_validation_error(
    exception: ValidationError, schema: type[BaseModel]
) -> tuple[str, str]:
    """Key and plain words for the first finding of a pydantic ValidationError."""
    # an unknown key explains a missing one: name it first
    findings = sorted(exception.errors(), key=lambda f: f["type"] != "extra_forbidden")
    first = findings[0]
    path = [part for part in first["loc"] if not _is_pydantic_tag(part)]
    key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")
    if first["type"] == "extra_forbidden":
        known = _keys_beside(schema, path)
        hint = f"; known keys: {', '.join(known)}" if known else ""
        return key, f"unknown key{hint}"
    if first["type"] == "missing":
        return key, "is missing"
    found = first.get("input")
    words = str(first["msg"]).removeprefix("Value error, ")
    if first["type"] in ("value_error", "assertion_error"):
        return key, words
    shown = "nothing" if found is None else f"'{found}'"
    if len(shown) > 60:
        shown = shown[:56] + "...'"
    words = words[0].lower() + words[1:]
    words = words.removeprefix("input should be ").removeprefix("a valid ")
    return key, f"found {shown}; expected {words}"


def _is_pydantic_tag(part: object) -> bool:
    """Whether a part of a location is pydantic's name for a branch of a union, not a key."""
    return isinstance(part, str) and ("[" in part or part in {"float", "int", "str", "bool"})


def _keys_beside(schema: type[BaseModel], path: list[Any]) -> list[str]:
    """Names of the fields that stand where an unknown key was found."""
    from pydantic import BaseModel

    current: Any = schema
    for part in path[:-1]:
        if isinstance(current, type) and issubclass(current, BaseModel):
            field = next((f for n, f in current.model_fields.items() if part in (n, f.alias)), None)
            current = None if field is None else field.annotation
        current = _schema_within(current)
    current = _schema_within(current)
    if current is None:
        return []
    return [f.alias or n for n, f in current.model_fields.items()]


def _schema_within(annotation: Any) -> Any:  # noqa: ANN401 - typing objects
    """The pydantic schema inside an annotation such as dict[str, Schema] or Schema | None."""
    from typing import get_args

    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        found = _schema_within(inner)
        if found is not None:
            return found
    return None


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all: beside it first, then renamed.

    Raises:
        OrthocalError: If the folder does not exist or cannot be written to.
    """
    write_files(path.parent, {path.name: text})


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write several files of one folder, all or none; the folder is made if need be.

    Raises:
        OrthocalError: If the folder cannot be made or written to.
    """
    pending: list[tuple[str, Path]] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            handle, temporary = tempfile.mkstemp(dir=folder, prefix=f".{name}.")
            pending.append((temporary, folder / name))
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
                stream.write(text)
            os.chmod(temporary, 0o644)
        for temporary, final in pending:
            os.replace(temporary, final)
    except OSError as e:
        raise OrthocalError(f"cannot be written: {e.strerror}", where=str(folder)) from None
    finally:
        for temporary, _ in pending:
            Path(temporary).unlink(missing_ok=True)

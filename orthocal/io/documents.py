"""YAML, JSON and CSV from untrusted sources: bounded reading, validation, messages with places.

The caller of a reader of YAML or JSON chooses the kind of error to raise.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, cast, get_args, get_origin, get_type_hints

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from orthocal.errors import OrthocalError, SessionError
from orthocal.io.files import read_file
from orthocal.io.strict_yaml import DEEPEST, LARGEST_YAML, LONGEST_NUMBER, load_yaml
from orthocal.text import composed, list_some, shorten, text_problem, uncapitalised

Record = TypeVar("Record")


def _refuse_booleans(value: object) -> object:
    """Refuse yes and no of YAML, which pydantic would convert to 1 and 0."""
    if isinstance(value, bool):
        raise PydanticCustomError("float_type", "Input should be a valid number")
    return value


LARGEST_NUMBER = 1e9
"""Largest length, angle or coordinate in a file, in any unit."""

SMALLEST_POSITIVE = 1e-9
"""Smallest standard deviation, tolerance or resolution in a file, in any unit."""


def _refuse_huge(value: float) -> float:
    """Refuse a number beyond LARGEST_NUMBER."""
    if abs(value) > LARGEST_NUMBER:
        raise PydanticCustomError("huge", f"Input should be within ±{LARGEST_NUMBER:g}")
    return value


SMALLEST_IN_SI = 1e-16
"""Smallest standard deviation in SI units; the square of a quotient by it does not overflow."""


def _at_least(smallest: float) -> AfterValidator:
    """Validator that refuses a number below the smallest one."""

    def refuse_smaller(value: float) -> float:
        if value < smallest:
            raise PydanticCustomError("tiny", f"Input should be at least {smallest:g}")
        return value

    return AfterValidator(refuse_smaller)


class Keys(BaseModel):
    """Keys of a document; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class OneKey(Keys):
    """Keys of which exactly one is stated."""

    @model_validator(mode="after")
    def _require_one(self) -> Self:
        """Refuse several keys, or none."""
        stated = [key for key, value in self if value is not None]
        if len(stated) != 1:
            expected = ", ".join(type(self).model_fields)
            raise ValueError(f"found {' and '.join(stated) or 'none'}; expected one of {expected}")
        return self

    @property
    def stated(self) -> tuple[str, Any]:
        """The stated key and its value."""
        return next((key, value) for key, value in self if value is not None)


Number = Annotated[
    float,
    BeforeValidator(_refuse_booleans),
    Field(allow_inf_nan=False),
    AfterValidator(_refuse_huge),
]
"""Number within ±LARGEST_NUMBER; yes and no of YAML are not numbers."""

Count = Annotated[int, Field(ge=0, le=10**9)]
"""Whole number from 0 to 10⁹."""

PositiveNumber = Annotated[Number, Field(gt=0.0), _at_least(SMALLEST_POSITIVE)]
"""Number from SMALLEST_POSITIVE to LARGEST_NUMBER."""

Name = Annotated[
    str,
    Field(min_length=1, max_length=200, pattern=r"^[^,;\s\"]+$"),
    AfterValidator(composed),
]
"""Name that needs no quotes in a CSV file."""

PositiveInSI = Annotated[Number, Field(gt=0.0), _at_least(SMALLEST_IN_SI)]
"""Positive number in SI units that users state in mm, mrad or ppm."""

MOST_JSON_VALUES = 2_000_000
"""Largest number of keys and values of a JSON file; a calibration has forty per reading."""

MOST_CSV_ROWS = 1_000_000
"""Largest number of rows of a CSV file."""

_LONG_NUMBER = re.compile(rf"[-+.eE0-9]{{{LONGEST_NUMBER + 1}}}")

MOST_SHOWN = 20
"""Largest number of items of a list or mapping that a message shows."""


def read_text(
    path: Path,
    *,
    error: type[OrthocalError],
    content: bytes | None = None,
    largest: int | None = None,
) -> str:
    """Text of a UTF-8 file, without a byte order mark.

    Args:
        path: The file.
        error: Kind of error to raise.
        content: Content of the file, if it was read before.
        largest: Largest size, [bytes]; default: LARGEST_FILE.

    Raises:
        OrthocalError: Of kind `error`, if the file is missing, too large or not UTF-8.
    """
    if content is None:
        content = read_file(path, error=error)
    if largest is not None and len(content) > largest:
        raise error(
            f"has {len(content) / 2**20:.1f} MiB; expected at most {largest / 2**20:g} MiB",
            where=str(path),
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise error(f"is not UTF-8 text (byte {e.start})", where=str(path)) from None


def read_yaml(path: Path, *, error: type[OrthocalError], content: bytes | None = None) -> Any:  # noqa: ANN401 - any document
    """Content of a YAML file; duplicate keys, aliases and other tags are errors.

    Args:
        path: The file.
        error: Kind of error to raise.
        content: Content of the file, if it was read before.

    Raises:
        OrthocalError: Of kind `error`, if the file is invalid; names file and line.
    """
    text = read_text(path, error=error, content=content, largest=LARGEST_YAML)
    try:
        return load_yaml(text)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        line = "" if mark is None else f":{mark.line + 1}"
        problem = str(e.problem)
        if problem.startswith("but "):  # the context is the first half of PyYAML's sentence
            problem = f"{e.context}, {problem}"
        if mark is not None and text[mark.index : mark.index + 1] == "\t":
            problem += " (a tab; indent with spaces)"
        raise error(f"is not valid YAML: {problem}", where=f"{path}{line}") from None
    except (yaml.YAMLError, ValueError, OverflowError) as e:
        text = " ".join(str(e).split())
        raise error(f"is not valid YAML: {text or type(e).__name__}", where=str(path)) from None


def read_json(path: Path, *, error: type[OrthocalError]) -> Any:  # noqa: ANN401 - any document
    """Content of a JSON file.

    Raises:
        OrthocalError: Of kind `error`, if the file is invalid; names file and line.
    """
    text = read_text(path, error=error)
    commas_and_brackets = sum(text.count(c) for c in ",[{")
    if commas_and_brackets > MOST_JSON_VALUES:
        raise error(
            f"holds about {commas_and_brackets} values; expected at most {MOST_JSON_VALUES}",
            where=str(path),
        )

    def to_dict(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key, value in pairs:
            if key in result:
                raise ValueError(f"the key '{shorten(key)}' occurs twice")
            result[key] = value
        return result

    def require_short(digits: str) -> str:
        if len(digits) > LONGEST_NUMBER:
            raise ValueError(f"the number {shorten(digits)} has {len(digits)} characters")
        return digits

    parsers: dict[str, Any] = {}
    if _LONG_NUMBER.search(text):  # otherwise the faster parsers of the json module suffice
        parsers = {
            "parse_int": lambda digits: int(require_short(digits)),
            "parse_float": lambda digits: float(require_short(digits)),
        }
    try:
        document = json.loads(text, object_pairs_hook=to_dict, **parsers)
        _check_texts(document)
        return document
    except json.JSONDecodeError as e:
        raise error(f"is not valid JSON: {e.msg}", where=f"{path}:{e.lineno}") from None
    except (ValueError, RecursionError) as e:
        raise error(f"is not valid JSON: {e or type(e).__name__}", where=str(path)) from None


def _check_texts(document: object) -> None:
    """Refuse control characters and half surrogate pairs in any text of a document.

    Raises:
        ValueError: If the document contains such a text, or is nested too deeply.
    """
    pending: list[tuple[Any, int]] = [([document], 0)]
    while pending:
        value, depth = pending.pop()
        if depth > DEEPEST:
            raise ValueError(f"lists and objects are nested more than {DEEPEST} deep")
        for item in value if isinstance(value, list) else (*value, *value.values()):
            if isinstance(item, list | dict):
                pending.append((item, depth + 1))
            elif isinstance(item, str):
                problem = text_problem(item)
                if problem:
                    raise ValueError(problem)


def csv_rows(
    lines: Iterable[str],
    *,
    name: str,
    required: tuple[str, ...],
    optional: tuple[str, ...] | None = (),
    most: int | None = None,
) -> Iterator[tuple[int, dict[str, str]]]:
    """Line numbers and cells by column of the rows of a CSV file with a header.

    Blank lines are skipped. The separator is a semicolon if the header has one and no comma.

    Args:
        lines: Lines with their line ends.
        name: Name of the file, for messages.
        required: Required columns.
        optional: Optional columns; None to ignore all others.
        most: Largest number of lines.

    Raises:
        SessionError: If a row is invalid; names file and line.
    """
    lines = iter(lines)
    first_line = next(lines, "")
    if not first_line.strip():
        problem = "is blank" if any(line.strip() for line in lines) else "is empty"
        raise SessionError(f"{problem}; expected a header: {','.join(required)}", where=f"{name}:1")
    delimiter = ";" if "," not in first_line and ";" in first_line else ","
    rows = csv_cells(chain([first_line], lines), delimiter, name=name, most=most)
    header = [composed(cell.strip()) for cell in next(rows)[1]]
    if invalid := _header_problem(header, required, optional):
        raise SessionError(invalid, where=f"{name}:1")
    read = [(i, c) for i, c in enumerate(header) if optional is not None or c in required]
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            maybe_comma = delimiter == "," and len(row) > len(header)
            hint = "; a decimal comma? write a point" if maybe_comma else ""
            raise SessionError(
                f"has {len(row)} fields; expected {len(header)} ({delimiter.join(header)}){hint}",
                where=f"{name}:{line}",
            )
        yield line, {c: composed(row[i].strip()) for i, c in read}


def csv_cells(
    lines: Iterable[str], delimiter: str, *, name: str, most: int | None
) -> Iterator[tuple[int, list[str]]]:
    """Last line and cells of each row of a CSV file.

    Args:
        lines: Lines with their line ends.
        delimiter: Character between cells.
        name: Name of the file, for messages.
        most: Largest number of lines; None for any number.

    Raises:
        SessionError: If quotes do not match, or there are more lines; names file and line.
    """
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        for cells in reader:
            if most is not None and reader.line_num > most:
                raise SessionError(f"has more than {most} rows", where=name)
            yield reader.line_num, cells
    except csv.Error as e:
        raise SessionError(f"is not valid CSV: {e}", where=f"{name}:{reader.line_num}") from None


def _header_problem(
    header: Sequence[str], required: Sequence[str], optional: Sequence[str] | None
) -> str | None:
    """First problem with the columns of a CSV file; None if there is none."""
    for name in header:
        if optional is not None and name not in (*required, *optional):
            more = f" and optionally {', '.join(optional)}" if optional else ""
            return f"unknown column '{shorten(name)}'; expected {', '.join(required)}{more}"
        if header.count(name) > 1 and (optional is not None or name in required):
            return f"the column '{name}' occurs twice"
    missing = next((name for name in required if name not in header), None)
    if missing is None:
        return None
    return f"the column '{missing}' is missing; found {shorten(', '.join(header))}"


_DECIMAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf\w*)", re.I)


def parse_number(
    text: str,
    *,
    name: str,
    error: type[OrthocalError],
    where: str | None = None,
    largest: float = LARGEST_NUMBER,
) -> float:
    """Finite number in a CSV field.

    Raises:
        OrthocalError: Of kind `error`, for other text, NaN, infinity, a decimal comma or a number
            beyond `largest`.
    """
    try:
        if len(text) > LONGEST_NUMBER or not _DECIMAL.fullmatch(text):
            raise ValueError
        value = float(text)
    except ValueError:
        hint = " (a decimal comma? write a point)" if "," in text else ""
        raise error(f"{name} is '{shorten(text)}'; expected a number{hint}", where=where) from None
    if value - value != 0.0:
        raise error(f"{name} is '{text}'; expected a finite number", where=where)
    if abs(value) > largest:
        raise error(f"{name} is '{text}'; expected a number within ±{largest:g}", where=where)
    return value


def validate(
    schema: type[Record],
    data: Any,  # noqa: ANN401 - any document
    *,
    where: str,
    error: type[OrthocalError],
    under: str = "",
) -> Record:
    """Convert plain data to an instance of a pydantic model or of a dataclass.

    Args:
        schema: The model or dataclass.
        data: Plain data from a document.
        where: Name of the file, for messages.
        error: Kind of error to raise.
        under: Key of the data in the file.

    Raises:
        OrthocalError: Of kind `error`, if the data are invalid; names the first invalid key, or all
            missing ones.
    """
    if not isinstance(data, Mapping):
        kinds = {str: "text", int: "a number", float: "a number", list: "a list", bool: "a word"}
        kind = "nothing" if data is None else kinds.get(type(data), f"a {type(data).__name__}")
        where = f"{where}: {under}" if under else where
        raise error(f"holds {kind}; expected keys and values", where=where)
    try:
        return cast("Record", _adapter(schema).validate_python(data))  # type: ignore[arg-type] # types are hashable
    except ValidationError as e:
        if missing := _find_missing(e, under):
            raise missing_keys_error(missing, where, error) from None
        key, problem = _explain(e, schema)
        key = ".".join(name for name in (under, key) if name)
        raise error(problem, where=f"{where}: {key}" if key else where) from None


def format_json(document: object) -> str:
    """Text of a JSON document, with a line end.

    Raises:
        ValueError: If a number is not finite.
    """
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def write_plain(record: object, schema: type[Any]) -> dict[str, Any]:
    """Plain data of a dataclass, which `validate` reads."""
    adapter = _adapter(schema)  # type: ignore[arg-type] # types are hashable
    return cast("dict[str, Any]", adapter.dump_python(record, mode="json", by_alias=True))


@cache
def _adapter(schema: Any) -> TypeAdapter[Any]:  # noqa: ANN401 - a hashable type
    return TypeAdapter(schema)


UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
"""Pydantic's error types for an unknown key of a model and of a dataclass."""


KEYS_AND_VALUES = (
    "dict_type",
    "mapping_type",
    "dataclass_type",
    "model_type",
    "model_attributes_type",
)
"""Pydantic's error types for a value that is no mapping."""

PARSED = {"float_parsing": "a number", "int_parsing": "a whole number"}
"""Expected input by pydantic's error types for texts that are not numbers."""


def describe_missing(others: Sequence[str]) -> str:
    """Problem of a missing key.

    Args:
        others: The other missing keys of the document.
    """
    so = "is" if len(others) == 1 else "are"
    return f"is missing, and so {so} {list_some(others, MOST_SHOWN)}" if others else "is missing"


def missing_keys_error(
    keys: Sequence[str], where: str, error: type[OrthocalError]
) -> OrthocalError:
    """Error about missing keys of a document.

    Args:
        keys: The keys, at least one.
        where: Name of the file.
        error: Kind of the error.
    """
    return error(describe_missing(keys[1:]), where=f"{where}: {keys[0]}", missing=keys)


def _find_missing(exception: ValidationError, under: str) -> list[str]:
    """Missing keys; empty if another error comes first, or an unknown key may be a misspelled one.

    Args:
        exception: The error.
        under: Key of the data in the file.
    """
    errors = exception.errors(include_url=False)
    if errors[0]["type"] != "missing" or any(e["type"] in UNKNOWN_KEY for e in errors):
        return []
    paths = [list(e["loc"]) for e in errors if e["type"] == "missing"]
    others = [path for path in paths[1:] if not any(map(_is_pydantic_tag, path))]
    first = [part for part in paths[0] if not _is_pydantic_tag(part)]
    prefix = f"{under}." if under else ""
    return [prefix + _join(path) for path in (first, *others)]


def _explain(exception: ValidationError, schema: type[Any]) -> tuple[str, str]:
    """Key and problem of the first error in a pydantic ValidationError, an unknown key first.

    Args:
        exception: The error.
        schema: The model or dataclass.
    """
    errors = exception.errors(include_url=False)
    first = min(errors, key=lambda e: e["type"] not in UNKNOWN_KEY)
    path = [part for part in first["loc"] if not _is_pydantic_tag(part)]
    value, kind = first.get("input"), first["type"]
    if "[key]" in first["loc"] and not isinstance(value, str):
        return _join(path[:-1]), f"found the key {_show(value)}; expected text: put it in quotes"
    key = _join(path)
    if kind in UNKNOWN_KEY:
        keys = _keys_at(schema, path[:-1])
        hint = f"; known keys: {', '.join(keys)}" if keys else ""
        return key, f"unknown key{hint}"
    message = str(first["msg"]).removeprefix("Value error, ")
    if kind in ("value_error", "assertion_error"):
        # the message of a validator of several keys has the form "KEY|PROBLEM"
        inner_key, separator, problem = message.partition("|")
        if not separator:
            return key, message
        return _join([*path, inner_key] if inner_key else path), problem
    shown = "nothing" if value is None else f"'{_show(value)}'"
    comma = kind in PARSED and isinstance(value, str) and re.fullmatch(r"\s*[-+]?\d+,\d+\s*", value)
    hint = " (a decimal comma? write a point)" if comma else ""
    expected = _describe_expected(kind, message, first.get("ctx") or {})
    return key, f"found {shown}; expected {expected}{hint}"


def _show(value: object) -> str:
    """Text of a value from a document, shortened for a message."""
    if isinstance(value, list | dict) and len(value) > MOST_SHOWN:
        return f"{'a list' if isinstance(value, list) else 'a mapping'} of {len(value)} items"
    return shorten(str(value))


def _describe_expected(kind: str, message: str, context: Mapping[str, Any]) -> str:
    """Description of the expected input, from pydantic's error type and message."""
    if kind in PARSED:
        return PARSED[kind]
    if kind in KEYS_AND_VALUES:
        return "keys and values"
    if kind == "string_pattern_mismatch":
        return "a name without blanks, commas, semicolons or quotes"
    if kind in ("too_short", "too_long"):
        count = context["min_length" if kind == "too_short" else "max_length"]
        bound = "least" if kind == "too_short" else "most"
        return f"at {bound} {count} item{'' if count == 1 else 's'}"
    expected = uncapitalised(message)
    return expected.removeprefix("input should be ").removeprefix("a valid ")


def _join(path: list[Any]) -> str:
    """Text of a location, such as setups.yx.section or closed_loop[2]."""
    parts = (f"[{p}]" if isinstance(p, int) else f".{shorten(str(p))}" for p in path)
    return "".join(parts).lstrip(".")


def _is_pydantic_tag(part: object) -> bool:
    """True for a part of a location that is not a key but pydantic's name of a union branch."""
    return isinstance(part, str) and ("[" in part or part in {"float", "int", "str", "bool"})


def _keys_at(annotation: Any, path: list[Any]) -> list[str]:  # noqa: ANN401 - typing objects
    """Known keys of a schema at a location."""
    fields: dict[str, Any] | None = None
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        fields = {f.alias or n: f.annotation for n, f in annotation.model_fields.items()}
    elif isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        hints = get_type_hints(annotation, include_extras=True)
        names = [f.name for f in dataclasses.fields(annotation)]
        fields = {_alias(hints[n]) or n: hints[n] for n in names}
    if fields is not None:
        if not path:
            return list(fields)
        return _keys_at(fields[path[0]], path[1:]) if path[0] in fields else []
    if get_origin(annotation) is Annotated:
        return _keys_at(get_args(annotation)[0], path)
    arguments = get_args(annotation)
    if get_origin(annotation) is tuple:
        return _keys_at(arguments[0], path[1:])
    if get_origin(annotation) in (dict, list):
        return _keys_at(arguments[-1], path[1:])
    return next((keys for a in arguments if (keys := _keys_at(a, path))), [])


def _alias(hint: Any) -> str | None:  # noqa: ANN401 - typing objects
    """Key of a dataclass field in a file, if it differs from the field's name."""
    aliases = (m.alias for m in get_args(hint)[1:] if isinstance(m, FieldInfo))
    return next((alias for alias in aliases if alias), None)

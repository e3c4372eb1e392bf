"""Field types of records that are stored as JSON: closed records, unknown numbers, arrays.

A record is a dataclass, which pydantic reads and writes with the help of these annotations. In a
file, null represents NaN or infinity only.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    ConfigDict,
    Field,
    GetPydanticSchema,
    PlainSerializer,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import core_schema

from orthocal.arrays import Array
from orthocal.io.documents import LARGEST_NUMBER, Number

Item = TypeVar("Item")


class FileRecord:
    """Base of the records that files contain; unknown keys are refused."""

    __slots__ = ()
    __pydantic_config__ = ConfigDict(extra="forbid")


Many = Annotated[tuple[Item, ...], Field(fail_fast=True)]
"""Any number of items; validation stops at the first invalid one."""

Size = Annotated[Number, Field(ge=0.0)]
"""A number that is not negative."""


def _null_for(unknown: float) -> WrapValidator:
    """Validator that reads null as NaN or infinity."""

    def read(value: object, handler: ValidatorFunctionWrapHandler) -> object:
        return unknown if value is None else handler(value)

    return WrapValidator(read)


def finite_or_none(value: float) -> float | None:
    """A finite number; None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


NumberOrNaN = Annotated[Number, _null_for(math.nan), PlainSerializer(finite_or_none)]
SizeOrNaN = Annotated[Size, _null_for(math.nan), PlainSerializer(finite_or_none)]
SizeOrInf = Annotated[Size, _null_for(math.inf), PlainSerializer(finite_or_none)]
"""Numbers that may be unknown or infinite."""


def _as_lists(lists: Any) -> GetPydanticSchema:  # noqa: ANN401 - a type
    """Array in memory, nested lists in a file, where null replaces numbers that are not finite."""
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            _to_array,
            handler.generate_schema(lists),
            serialization=core_schema.plain_serializer_function_ser_schema(_to_lists),
        )
    )


_Entry = Annotated[
    float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)
]
"""Number of an array, which pydantic checks without calling Python."""

Vector = Annotated[Array, _as_lists(Many[_Entry])]
Sizes = Annotated[Array, _as_lists(Many[Annotated[_Entry, Field(ge=0.0)]])]
Matrix = Annotated[Array, _as_lists(Many[Many[_Entry | None]])]


def _to_array(lists: Any) -> Array:  # noqa: ANN401 - tuples of tuples
    if len({len(row) for row in lists if isinstance(row, tuple)}) > 1:
        raise ValueError("expected rows of the same length")
    return read_only(lists)


def _to_lists(values: Array) -> object:
    if np.isfinite(values).all():
        return values.tolist()
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def read_only(values: ArrayLike) -> Array:
    """Read-only copy of an array."""
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy

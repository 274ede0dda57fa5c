"""Types for the models of a cell file: numbers with limits, and the base class of all models."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from penumbra.shared.cell.faults import Faulty
from penumbra.shared.cell.names import NAME


def _number(value: Any) -> Any:
    if isinstance(value, bool):
        got = "true" if value else "false"
        raise Faulty([("", f"expected a number, got {got}; YAML reads yes, no, on and off as true and false")])
    return value


Number = Annotated[float, BeforeValidator(_number)]
Whole = Annotated[int, BeforeValidator(_number)]
Metres = Annotated[Number, Field(ge=-1e4, le=1e4)]
Radians = Annotated[Number, Field(ge=-6.3, le=6.3)]
"""An angle [rad] of up to one turn; a larger number is likely in degrees."""
Vector3 = tuple[Metres, Metres, Metres]
Angles3 = tuple[Radians, Radians, Radians]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Length = Annotated[Number, Field(gt=0, le=1)]
"""A length on a pad [m]; a larger number is likely in millimetres."""
Measure = Annotated[Number, Field(ge=0.02, le=3)]
"""A body measure of a person [m]."""
Name = Annotated[str, Field(pattern=NAME)]


class Model(BaseModel):
    """A map of a cell file: frozen, and without unknown keys."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, ignored_types=(cached_property,), protected_namespaces=()
    )

    def __eq__(self, other: object) -> bool:
        """Compares the fields only: pydantic also compares cached arrays, which have no truth value."""
        return type(self) is type(other) and all(getattr(self, name) == getattr(other, name) for name in type(self).model_fields)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with some fields changed. Cached values depend on the old fields and are dropped."""
        copied = super().model_copy(update=update, deep=deep)
        for name in vars(copied).keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied

"""The base class of the sections of an experiment file, and names of registries as values; see schema.py."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Annotated, Any

from annotated_types import Len
from pydantic import AfterValidator, BaseModel, ConfigDict, field_validator
from pydantic_core import PydanticCustomError

from torchmbd.errors import nearest
from torchmbd.math import units
from torchmbd.study.file_errors import shown

UNITS = {name: multiple for name, (multiple, _) in units.UNITS.items()}  # unit -> SI
Numbers = float | Annotated[list[float], Len(min_length=1)]


def fault(text: str, *path: str) -> PydanticCustomError:
    """Make the error of a validator; `text` follows the path in the message, `path`: keys below what is validated."""
    return PydanticCustomError("fault", "{text}", {"text": text, "path": path})


def one_of(names: Collection[str] | Callable[[], Collection[str]]) -> AfterValidator:
    """Accept a name of a registry only."""

    def check(name: str) -> str:
        allowed = names() if callable(names) else names
        if name not in allowed:
            raise fault(f"= {shown(name)}: {nearest(name, allowed)[2:]}")
        return name

    return AfterValidator(check)


Unit = Annotated[str, one_of(UNITS)]


class Section(BaseModel):
    """Part of a file: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_empty_value(cls, value: Any) -> Any:
        """A key without a value was most likely forgotten: its default is that of no key."""
        if value is None:
            raise fault("= null: no value; allowed: a value, or the file without this key")
        return value

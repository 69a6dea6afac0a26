"""The base class of the sections of an experiment file, and names of registries as values; see schema.py."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any, LiteralString

from annotated_types import Len
from pydantic import AfterValidator, BaseModel, ConfigDict, field_validator
from pydantic_core import PydanticCustomError

from torchmbd.errors import must, nearest
from torchmbd.math import units
from torchmbd.study.file.faults import shown

UNITS = {name: multiple for name, (multiple, _) in units.UNITS.items()}  # unit -> SI
Numbers = float | Annotated[list[float], Len(min_length=1)]


def fault(
    state: str, *path: str | int, allowed: str = "", hint: str = "", kind: LiteralString = "fault"
) -> PydanticCustomError:
    """Make the error of a validator.

    state          what is wrong; it follows the path in the message
    path           keys below what is validated
    allowed, hint  as of InputError
    """
    return PydanticCustomError(kind, "{state}", {"state": state, "allowed": allowed, "hint": hint, "path": path})


class NameOf(AfterValidator):
    """Accept a name of a registry only; the JSON schema lists them."""

    def __init__(self, names: Collection[str]) -> None:
        def check(name: str) -> str:
            if name not in names:
                raise fault(f"= {shown(name)}", allowed=must(tuple(names)), hint=nearest(name, names))
            return name

        super().__init__(check)
        object.__setattr__(self, "names", names)

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        return handler(core_schema) | {"enum": list(vars(self)["names"])}


Unit = Annotated[str, NameOf(UNITS)]
BESIDE = "responses"


def beside(key: str, responses: str) -> ConfigDict:
    """Tell the JSON schema that the keys of a response, "History" or "Measure", stand in a section in place of `key`."""

    def change(schema: dict[str, Any]) -> None:
        del schema["properties"][key], schema["required"], schema["additionalProperties"]
        schema[BESIDE] = responses

    return ConfigDict(json_schema_extra=change)


class Section(BaseModel):
    """Part of a file: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_empty_value(cls, value: Any) -> Any:
        """A key without a value was most likely forgotten: its default is that of no key."""
        if value is None:
            raise fault("= null", allowed="must have a value, or be left out")
        return value

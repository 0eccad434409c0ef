"""What requests may hold. Unknown fields are refused: a misspelled one would be silently without effect."""

import math
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from lvba.pipeline import Config
from lvba.sources.importing.options import ImportOptions
from service.datasets import file_names
from service.system.printable import printable

_DEEPEST = 8
_UNKNOWN = 20
"""Fields of an object that are told to be unknown one by one."""


def _clean(text: str) -> str:
    """Without what a database or a terminal cannot take."""
    if printable(text) != text:
        raise ValueError("holds control characters, or others that are not seen")
    return text


def _plain_name(text: str) -> str:
    """Without what could lead elsewhere where somebody makes a folder of this name."""
    if not file_names.is_plain(_clean(text)):
        raise ValueError(
            "is no name: it begins with . or ~ or a space, holds / or \\, or is that of a device"
        )
    return text


def _as_given(value: Any, check: ValidatorFunctionWrapHandler) -> Any:
    return check(value)


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    _check_plain(value, 0)
    return value


def _check_plain(value: Any, depth: int) -> None:
    if depth > _DEEPEST:
        raise ValueError("is nested too deeply")
    if isinstance(value, dict):
        for name, inner in value.items():
            _clean(name)
            _check_plain(inner, depth + 1)
    elif isinstance(value, list):
        for inner in value:
            _check_plain(inner, depth + 1)
    elif isinstance(value, str):
        _clean(value)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError("holds a number that is not finite")
    elif isinstance(value, int) and abs(value) > 1 << 53:
        raise ValueError("holds a number that is too large")


Text = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_clean)]
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_plain_name)]
Inputs = Annotated[dict[str, Any], AfterValidator(_plain)]
RunSettings = Annotated[
    dict[str, Any], WrapValidator(_as_given, json_schema_input_type=Config), AfterValidator(_plain)
]
"""Settings of a run: described by their dataclasses, kept as they are given, and checked as on the command line
(`config.from_mapping`, in `submission`), so that every mistake has one text everywhere."""
ImportChoices = Annotated[
    dict[str, Any], WrapValidator(_as_given, json_schema_input_type=ImportOptions), AfterValidator(_plain)
]
"""Options of the import of a bag, in the same way (`import_choices.read`)."""
Days = Annotated[float, Field(gt=0, le=36500, allow_inf_nan=False)]
Priority = Annotated[int, Field(ge=-10, le=10)]
DatasetId = Annotated[str, Field(pattern=r"^ds_[0-9a-f]{1,40}$")]


class _Strict(BaseModel):
    # docstrings of fields are their descriptions where they have no others
    model_config = ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _few(cls, value: Any) -> Any:
        # each unknown field would become an error of its own, which takes longer than to read it
        if isinstance(value, dict) and len(value) > len(cls.model_fields) + _UNKNOWN:
            raise ValueError(f"has {len(value)} fields; known are {', '.join(cls.model_fields)}")
        return value


class NewDataset(_Strict):
    """A dataset to be made."""

    name: Name
    folder: Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_clean)] | None = None
    """Of a recording on the server, absolute, or a URL such as s3://bucket/recording; None: it is uploaded."""


class Webhook(_Strict):
    """Who is told at the end."""

    url: Annotated[str, Field(max_length=1000), AfterValidator(_clean)]
    secret: Annotated[str, Field(min_length=16, max_length=200), AfterValidator(_clean)]


class NewJob(_Strict):
    """A run that is asked for."""

    model_config = ConfigDict(extra="forbid", strict=True, populate_by_name=True)
    dataset: DatasetId
    name: Name | None = None
    config: RunSettings = Field(default_factory=dict)
    import_: ImportChoices | None = Field(default=None, alias="import")
    priority: Priority = 0
    reference: bool = False
    keep_days: Days | None = None
    webhook: Webhook | None = None


class ChangedJob(_Strict):
    """What of a job may be changed at any time."""

    name: Name | None = None
    priority: Priority | None = None
    keep_days: Days | None = None


class Restart(_Strict):
    """How an ended job is begun anew."""

    model_config = ConfigDict(extra="forbid", strict=True, populate_by_name=True)
    from_stage: Text | None = Field(default=None, alias="from")
    config: RunSettings | None = None
    import_: ImportChoices | None = Field(default=None, alias="import")


class NewBatch(_Strict):
    """Jobs that belong together."""

    name: Name
    jobs: Annotated[list[NewJob], Field(min_length=1, max_length=1000)]


class TicketFor(_Strict):
    """What a ticket is to be good for."""

    path: Annotated[
        str,
        Field(max_length=800, pattern=r"^/v1/(jobs|datasets)/[a-z]+_[0-9a-f]+(/|$)"),
        AfterValidator(_clean),
    ]


class Execution(BaseModel):
    """An OGC execute request; what is not ours is ignored."""

    inputs: Inputs = Field(default_factory=dict)

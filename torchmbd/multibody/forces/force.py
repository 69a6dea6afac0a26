"""The base class of force elements: a force element is a list of actions between frames, as a joint is one of primitives.

    class SpringDamper(ForceElement):
        def actions(self, attachments): yield Applied(Length, (attachments.point(a), attachments.point(b)), law)

A new force element is one small file and one line in the registry.
Checked in tests/contracts/test_actions.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

from torch import Tensor

from torchmbd.errors import HintedKeywords, InputError
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.parametric_law import LawVariables
from torchmbd.multibody.joints.joint import AttachmentTable


class Applied(NamedTuple):
    """One action: its kind, the indices of its vectors, its law."""

    kind: type
    vectors: tuple[int, ...]
    law: Any


class ForceElement(FixedArguments, HintedKeywords):
    """Base of all force elements: the frames that it acts on, and a name.

    variables_in_laws   whether its design variables are numbers of laws, which are data of the motion: data["law NAME"]
    """

    variables_in_laws: ClassVar[bool] = True

    def __init__(self, frames: tuple[Any, ...], name: str | None = None):
        kind = type(self).__name__
        names = {1: ("frame",), 2: ("a", "b")}.get(len(frames), ("frames",) * len(frames))
        for key, frame in zip(names, frames, strict=True):
            if not isinstance(frame, Frame):
                raise InputError(key, frame, "must get frames, such as body.at(...)", state=f"got {frame!r}", noun=kind)
        if all(isinstance(frame.body, Ground) for frame in frames):
            raise InputError(
                names[-1],
                frames[-1],
                "must act on at least one frame on a body",
                state=f"acts on {', '.join(map(repr, frames))}",
                noun=kind,
            )
        if len(frames) == 2 and frames[0].body is frames[1].body:
            raise InputError(
                "b",
                frames[1],
                "must act between two different bodies",
                state=f"acts between {frames[0]!r} and {frames[1]!r}",
                noun=kind,
            )
        if name is not None and not isinstance(name, str):
            raise InputError("name", name, "a string", noun=f"name of a {kind}")
        self.frames: tuple[Frame, ...] = frames
        self.measured: tuple[Frame, ...] = ()  # frames without a force whose motion is read
        self.name = name or "_".join([kind.lower(), *(frame.body.name for frame in frames)])
        self.law_variables = LawVariables(self.name)

    @property
    def variables(self) -> ParameterVector | None:
        """Design variables, parameters of the system by the element's name; None: there are none."""
        return self.law_variables.variables

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        """Yield the actions of the element."""
        raise NotImplementedError(type(self).__name__)

    def beams(self, attachments: AttachmentTable) -> list[tuple[int, int]]:
        """Attached points at the start and the end of each of its beam elements (system/beams.py), which have `beam_data`."""
        return []

    def beam_data(self) -> dict[str, Tensor]:
        """Data of its beam elements in the present design [*lanes, elements, ...]."""
        raise NotImplementedError(type(self).__name__)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.frames))})"

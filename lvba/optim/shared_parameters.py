"""Parameters that all poses share (an extrinsic, a time offset, intrinsics ...), as one named block beside the poses.

A frozen dataclass names them: each field is one parameter and says by its kind how many numbers a step of it has, how
it moves by them and in which unit. Step, damping, covariance and prior read the layout off the fields, so a new
parameter is one field, one standard deviation in the prior, and one Jacobian in the factor that sees it:

    @dataclass(frozen=True)
    class Calibration(SharedParameters):
        scan_from_camera: np.ndarray = field(metadata=parameter(Pose()))
        time_offset: float = field(default=0.0, metadata=parameter(Scalar("s")))

A factor writes its derivatives by a parameter into the columns `Calibration.layout()["time_offset"]` of its
`normal_equations.Border`. A parameter that no factor says anything of is held; one that the data do not determine stays
where its prior has it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.optim.normal_equations import Border, NormalEquations, empty

_KIND = "shared parameter"
_LEAST_SIGMA = 1e-12
_MEAN_STEPS = 4
"""Each squares the error of the mean, which begins with that of the calibration."""


class Kind(Protocol):
    """How one parameter moves: what a step of `size` numbers in these units does to it."""

    @property
    def size(self) -> int:
        """Numbers in a step."""

    @property
    def units(self) -> tuple[str, ...]:
        """Of each number of a step."""

    def retract(self, value: Any, step: np.ndarray) -> Any:
        """The value moved by a (size,) step.

        step: (size,) float64
        """

    def deviation(self, reference: Any, value: Any) -> np.ndarray:
        """(size,): how far a value is off a reference."""

    def jacobian(self, reference: Any, value: Any) -> np.ndarray:
        """(size, size): of the deviation by a step from the value."""


@dataclass(frozen=True)
class Pose:
    """A (4, 4) transform; steps as in `geometry.retract`. Deviations: [rotation | position] in the reference's axes."""

    @property
    def size(self) -> int:
        """Six: [rotation | translation]."""
        return 6

    @property
    def units(self) -> tuple[str, ...]:
        """rad and m."""
        return ("rad",) * 3 + ("m",) * 3

    def retract(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """`value @ exp(step)`.

        value: (4, 4) float64, between any frames; step: (6,) float64, rad and m
        """
        return geometry.retract(value, step)

    def deviation(self, reference: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(6,): rotation vector and position of the value, seen from the reference.

        reference, value: (4, 4) float64, between the same two frames
        """
        back = reference[:3, :3].T
        rotation = Rotation.from_matrix(back @ value[:3, :3]).as_rotvec()
        return np.concatenate([rotation, back @ (value[:3, 3] - reference[:3, 3])])

    def jacobian(self, reference: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(6, 6).

        reference, value: (4, 4) float64, between the same two frames
        """
        matrix = np.zeros((6, 6))
        matrix[:3, :3] = geometry.inverse_right_jacobian(self.deviation(reference, value)[:3])
        matrix[3:, 3:] = reference[:3, :3].T @ value[:3, :3]
        return matrix


@dataclass(frozen=True)
class Vector:
    """A (size,) array that steps are added to."""

    size: int
    unit: str

    @property
    def units(self) -> tuple[str, ...]:
        """The same for all numbers."""
        return (self.unit,) * self.size

    def retract(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The sum.

        value: (size,) float64; step: (size,) float64
        """
        return np.asarray(value + step)

    def deviation(self, reference: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(size,): the difference.

        reference: (size,) float64; value: (size,) float64
        """
        return np.asarray(value - reference)

    def jacobian(self, reference: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(size, size): the identity.

        reference: (size,) float64; value: (size,) float64
        """
        return np.eye(self.size)


@dataclass(frozen=True)
class Scalar:
    """A float that steps are added to."""

    unit: str

    @property
    def size(self) -> int:
        """One."""
        return 1

    @property
    def units(self) -> tuple[str, ...]:
        """One."""
        return (self.unit,)

    def retract(self, value: float, step: np.ndarray) -> float:
        """The sum.

        step: (1,) float64
        """
        return value + float(step[0])

    def deviation(self, reference: float, value: float) -> np.ndarray:
        """(1,): the difference."""
        return np.array([value - reference])

    def jacobian(self, reference: float, value: float) -> np.ndarray:
        """(1, 1): one."""
        return np.eye(1)


def parameter(kind: Kind) -> dict[str, Kind]:
    """Metadata of a field of `SharedParameters`: one parameter of this kind."""
    return {_KIND: kind}


@dataclass(frozen=True)
class Layout:
    """Where each parameter is among the numbers of a step, in the order of the fields."""

    kinds: Mapping[str, Kind]

    @property
    def size(self) -> int:
        """Numbers of a step of all parameters."""
        return sum(kind.size for kind in self.kinds.values())

    @property
    def units(self) -> tuple[str, ...]:
        """Of each number."""
        return tuple(unit for kind in self.kinds.values() for unit in kind.units)

    def __getitem__(self, name: str) -> slice:
        """The numbers of one parameter."""
        names = list(self.kinds)
        start = sum(self.kinds[before].size for before in names[: names.index(name)])
        return slice(start, start + self.kinds[name].size)

    def named(self, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Numbers (k,) of all parameters, such as standard deviations, by name.

        numbers: (k,) float64
        """
        return {name: numbers[self[name]] for name in self.kinds}


@dataclass(frozen=True)
class SharedParameters:
    """Base of a dataclass whose fields are parameters, each with `parameter` as its metadata."""

    @classmethod
    def layout(cls) -> Layout:
        """Which numbers of a step are whose."""
        return Layout({each.name: each.metadata[_KIND] for each in fields(cls)})

    def retract(self, step: np.ndarray) -> Self:
        """All parameters moved by a (k,) step; an empty one, of equations without a border, moves none.

        step: (k,) float64
        """
        if not len(step):
            return self
        layout = self.layout()
        moved = {
            name: kind.retract(getattr(self, name), step[layout[name]]) for name, kind in layout.kinds.items()
        }
        return replace(self, **moved)

    def deviation(self, reference: Self) -> np.ndarray:
        """(k,): how far all parameters are off those of a reference."""
        parts = [
            kind.deviation(getattr(reference, name), getattr(self, name))
            for name, kind in self.layout().kinds.items()
        ]
        return np.concatenate(parts)

    def deviation_jacobian(self, reference: Self) -> np.ndarray:
        """(k, k): of `deviation` by the step that `retract` takes."""
        layout = self.layout()
        jacobian = np.zeros((layout.size, layout.size))
        for name, kind in layout.kinds.items():
            mine = layout[name]
            jacobian[mine, mine] = kind.jacobian(getattr(reference, name), getattr(self, name))
        return jacobian


def information(layout: Layout, sigma: Mapping[str, float | Sequence[float] | np.ndarray]) -> np.ndarray:
    """(k, k) information of parameters with these standard deviations, in the units of their steps.

    Raises ValueError: a parameter without a standard deviation, or a name that is none.
    """
    if set(sigma) != set(layout.kinds):
        raise ValueError(f"standard deviations of {sorted(sigma)}, parameters are {sorted(layout.kinds)}")
    each = [np.broadcast_to(sigma[name], kind.size) for name, kind in layout.kinds.items()]
    return np.diag(1.0 / np.square(np.concatenate(each)))


Parameters = TypeVar("Parameters", bound=SharedParameters)


@dataclass(frozen=True)
class SharedPrior(Generic[Parameters]):
    """What is known of shared parameters beforehand.

    reference: their values as calibrated
    claimed: (k, k) information of these, as the settings claim it
    counted: (k, k) information that they count with; None: as claimed
    granted: (k, k) information that they are good for, where data show it; None: as claimed
    """

    reference: Parameters
    claimed: np.ndarray
    counted: np.ndarray | None = None
    granted: np.ndarray | None = None

    @property
    def information(self) -> np.ndarray:
        """(k, k), what counts."""
        return self.claimed if self.counted is None else self.counted

    @property
    def good_for(self) -> np.ndarray:
        """(k, k), what it is good for."""
        return self.claimed if self.granted is None else self.granted

    def linearize(self, values: Parameters, shape: tuple[int, int]) -> NormalEquations:
        """Normal equations among blocks of `shape` (B, b), about which the prior says nothing."""
        off, by_step = values.deviation(self.reference), values.deviation_jacobian(self.reference)
        pull = self.information @ off
        border = Border(np.zeros((*shape, len(off))), self.hessian(values), by_step.T @ pull)
        return empty(*shape, border=border, cost=0.5 * float(off @ pull))

    def hessian(self, values: Parameters) -> np.ndarray:
        """(k, k), of the prior's cost."""
        by_step = values.deviation_jacobian(self.reference)
        return np.asarray(by_step.T @ self.information @ by_step)

    def gradient_variance(self, values: Parameters) -> np.ndarray:
        """(k, k), of the prior's gradient: its Hessian where it counts for what it is good for, more where for more."""
        by_step = values.deviation_jacobian(self.reference)
        varies = self.information @ np.linalg.solve(self.good_for, self.information)
        return np.asarray(by_step.T @ varies @ by_step)


def weighted_mean(
    reference: Parameters, values: Sequence[Parameters], sigma: Sequence[np.ndarray]
) -> Parameters:
    """The values about which the deviations of all are zero on average, weighed by the inverse of their variances.

    reference: first guess; sigma: (k,) for each of the values
    """
    weight = np.array([1 / np.maximum(each, _LEAST_SIGMA) ** 2 for each in sigma])
    mean = reference
    for _ in range(_MEAN_STEPS):
        off = np.array([each.deviation(mean) for each in values])
        mean = mean.retract((weight * off).sum(0) / weight.sum(0))
    return mean


def common_sigma(sigma: Sequence[np.ndarray]) -> np.ndarray:
    """(k,): standard deviations of `weighted_mean`, were the values independent; tiny where a parameter is held."""
    return np.asarray(
        1 / np.sqrt(np.sum([1 / np.maximum(each, _LEAST_SIGMA) ** 2 for each in sigma], axis=0))
    )

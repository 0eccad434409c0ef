"""The graph of images that pairs of them with known ratios of brightness make, and the exposures that explain it best."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from lvba.arrays import Indices
from lvba.visual import nearness, radiometry
from lvba.visual.radiometry import NONE, Radiometry, RadiometrySums
from lvba.visual.response import LINEAR, Response

BLOCKS = 8
"""Parts of the surface that the jackknife leaves out in turn."""
NORMAL = 1.4826
"""Standard deviation of normal errors over the median of their sizes."""
_GROSS = 5.0
"""Standard deviations beyond which a contradiction counts no more: such an edge is wrong by itself."""


@dataclass(frozen=True)
class Exposures:
    """Relative exposures of I images.

    log_exposure: (I,) float64, natural log; the first image of the whole is 0. Where the images fall in several
        components, each further one starts where the image before its first one ended: a guess, nothing measures it. So
        does a group of images that one block of the surface ties to others by a step that exposures do not make
    sigma: (I,) float64: standard deviation about the mean of the largest group of images that stay together whichever
        block of the surface is left out; inf for all others: a patch may be of another surface, and nothing tells then
    component: (I,) int32, connected component of the graph of compared images, by first image
    pairs: number of patch comparisons used
    spread: robust standard deviation of the log ratios of patches about the solution
    radiometry: that the exposures suppose
    contradiction: (I,) float64, at least 1: by how much edges that tie an image contradict each other, as part of the
        variance of its value
    """

    log_exposure: np.ndarray
    sigma: np.ndarray
    component: np.ndarray
    pairs: int
    spread: float
    contradiction: np.ndarray
    radiometry: Radiometry = NONE


@dataclass(frozen=True)
class Edges:
    """What all patches together say about each pair of images; two parts of the patches may each have an edge of a pair.

    first, second: (E,) int64, images; mean, sigma: (E,) of log(brightness in `second` / in `first`)
    weight_fraction: (E, 2 BLOCKS), of the weight, by block of the surface: first small blocks, then large ones
    pull: (E, 2 BLOCKS), that part times how far the mean of each block is off the edge's
    sharing: (M, 2) int64, edges that share patches, each two once; correlation: (M,) float64, of their errors
    pairs: number of patch comparisons; spread: their robust standard deviation about the edges' means
    radiometry: that the means suppose; by_radiometry: (E, NUMBERS), derivative of a mean by its numbers
    known: what the patches say of the radiometry; None: they were not asked
    curve: of the response, where it was taken out of the images before: the radiometry is what is left then
    """

    first: np.ndarray
    second: np.ndarray
    mean: np.ndarray
    sigma: np.ndarray
    weight_fraction: np.ndarray
    pull: np.ndarray
    sharing: np.ndarray
    correlation: np.ndarray
    pairs: int
    spread: float
    radiometry: Radiometry
    by_radiometry: np.ndarray
    known: RadiometrySums | None
    curve: Response = LINEAR

    @property
    def images_radiometry(self) -> Radiometry:
        """That of the images as they were taken."""
        return replace(self.radiometry, response=self.curve) if self.curve else self.radiometry

    @property
    def correlations(self) -> sparse.csr_matrix:
        """(E, E): of the errors of all edges."""
        count = len(self.mean)
        above = sparse.coo_matrix((self.correlation, self.sharing.T), shape=(count, count))
        return (above + above.T + sparse.identity(count)).tocsr()

    def supposing(self, radiometry: Radiometry) -> np.ndarray:
        """(E,): the means as they are with another radiometry, the patches weighed as before."""
        change = radiometry.numbers - self.radiometry.numbers
        return np.asarray(self.mean - np.einsum("ek,k->e", self.by_radiometry, change))


def solve_edges(edges: Edges, images: int) -> Exposures:
    """The exposures of all images that explain the edges best."""
    component = components(edges.first, edges.second, images)
    group = _tied_groups(edges, images)
    graph = _Graph(edges.first, edges.second, component, group)
    log_exposure, weight = graph.solve_robustly(edges.mean, edges.sigma)
    if common := graph.common_error(edges, log_exposure):
        edges = replace(edges, sigma=np.hypot(edges.sigma, common))
        log_exposure, weight = graph.solve_robustly(edges.mean, edges.sigma)
    contradiction = graph.contradiction(edges, log_exposure)
    sigma = graph.sigma(edges, log_exposure, weight, contradiction)
    largest = np.bincount(group).argmax() if images else 0
    return Exposures(
        log_exposure=_continued(log_exposure, component, group),
        sigma=np.where(group == largest, sigma, np.inf),
        component=component,
        pairs=edges.pairs,
        spread=edges.spread,
        contradiction=contradiction,
        radiometry=edges.images_radiometry,
    )


def components(first: Indices, second: Indices, images: int) -> np.ndarray:
    """(I,) int32: connected components of the graph that pairs of images make, by their first images.

    first, second: (M,) int32 or int64, images of each pair
    """
    links = sparse.coo_matrix((np.ones(len(first)), (first, second)), shape=(images, images))
    return _by_first_image(connected_components(links, directed=False)[1])


def _tied_groups(edges: Edges, images: int) -> np.ndarray:
    """(I,) int32: groups of images that stay together whichever small block of the surface is left out."""
    left = edges.weight_fraction[:, :BLOCKS].T <= 1 - _LITTLE
    without = [components(edges.first[some], edges.second[some], images) for some in left]
    return _by_first_image(np.unique(without, axis=1, return_inverse=True)[1].ravel())


def _by_radiometry(edges: Edges) -> np.ndarray:
    """(E, BLOCKS): changes of the means when the radiometry is found without one block of the surface."""
    if edges.known is None:
        return np.zeros((len(edges.mean), BLOCKS))
    numbers = radiometry.changes(edges.known, edges.radiometry)
    return np.asarray(-np.einsum("ek,bk->eb", edges.by_radiometry, numbers))


def _by_held_response(edges: Edges) -> np.ndarray:
    """(E,): changes of the means if the response was what fits best; 0 where one is used, or none was asked for.

    What is too little to be believed of a camera (that of sRGB, where all surfaces are bright) is in the exposures.
    """
    if edges.known is None or edges.radiometry.response or edges.curve:
        return np.zeros(len(edges.mean))
    numbers = radiometry.best(edges.known).response.numbers
    return np.asarray(edges.by_radiometry[:, radiometry.CURVE] @ numbers)


def _by_nearness(edges: Edges) -> np.ndarray:
    """(E,): changes of the means by what nearer views may seem brighter, beside what is taken out: what fits best where
    nothing is, else the least that an estimate is off."""
    if edges.known is None:
        return np.zeros(len(edges.mean))
    used = edges.radiometry.nearness
    off = nearness.FLOOR if used else radiometry.best_nearness(edges.known)
    return np.asarray(edges.by_radiometry[:, radiometry.NEARER.start] * off)


def robust_std(values: np.ndarray) -> float:
    """Standard deviation of values about 0 by their median absolute value, as if they were normal; 0 without any.

    values: (N,) float64
    """
    return float(NORMAL * np.median(np.abs(values))) if len(values) else 0.0


_LITTLE = 0.1
"""Part of an edge's weight that must be left for its mean to be taken anew without a block."""
_LEAST = 0.02
"""Part of its weight that an edge keeps without the block that all its patches lie on: it may alone join images."""


def _by_first_image(label: np.ndarray) -> np.ndarray:
    """Component numbers in the order of their first images."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse].astype(np.int32)


_FALLOFF_FLOOR = 0.002
"""Standard deviation of the part of the light that vignetting takes at the corner that no number of patches beats: nearer
views of a surface seem brighter or darker by something like that. Along a street it adds up to 0.3 % in 40 images."""
_COLUMNS = 64
"""Columns of an inverse that are in memory at a time."""
_BISECTIONS = 50


@dataclass(frozen=True)
class _Factor:
    """The normal equations of edges between images, of which those in `free` may have any value and the others have 0.

    group: (I,), each within one component; free: (F,); weighted: (E, F), the edges' signs times their weights
    """

    group: np.ndarray
    free: np.ndarray
    weighted: sparse.csr_matrix
    solver: SuperLU | None

    def values(self, differences: np.ndarray) -> np.ndarray:
        """Values of the images (I, K) that fit differences along the edges (E, K) best."""
        values = np.zeros((len(self.group), *differences.shape[1:]))
        if self.solver is not None:
            values[self.free] = self.solver.solve(np.asarray(self.weighted.T @ differences))
        return values

    def by_edges(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Some images (n,) at a time, and (E, n): by what the value of each, about the mean of its group, grows as
        the difference along an edge does."""
        count = np.bincount(self.group)
        for begin in range(0, len(self.group), _COLUMNS):
            images = np.arange(begin, min(begin + _COLUMNS, len(self.group)))
            about = (self.group[:, None] == self.group[images]) / -count[self.group[images]]
            about[images, images - begin] += 1.0
            solved = about[self.free] if self.solver is None else self.solver.solve(about[self.free])
            yield images, np.asarray(self.weighted @ solved)


@dataclass(frozen=True)
class _Graph:
    """Images joined by edges; the first image of every component stays at 0.

    component: (I,) that edges make of the images; group: (I,), parts of the components that are tied well
    """

    first: np.ndarray
    second: np.ndarray
    component: np.ndarray
    group: np.ndarray

    @cached_property
    def free(self) -> np.ndarray:
        """(F,) int64: images but the first of every component."""
        return np.setdiff1d(np.arange(len(self.component)), np.unique(self.component, return_index=True)[1])

    @cached_property
    def incidence(self) -> sparse.csr_matrix:
        """(E, F): -1 and 1 at the images of an edge, as far as they are free."""
        rows = np.tile(np.arange(len(self.first)), 2)
        signs = np.repeat([-1.0, 1.0], len(self.first))
        ends = np.concatenate([self.first, self.second])
        shape = len(self.first), len(self.component)
        return sparse.csr_matrix((signs, (rows, ends)), shape=shape)[:, self.free]

    def factor(self, weight: np.ndarray) -> "_Factor":
        """The edges' normal equations, factorized."""
        weighted = self.incidence.copy()
        weighted.data *= np.repeat(weight, np.diff(weighted.indptr))
        solver = splu((self.incidence.T @ weighted).tocsc()) if len(self.free) else None
        return _Factor(self.group, self.free, weighted, solver)

    def solve_robustly(self, value: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The images' values (I,) that fit the edges' (E,) with standard deviations (E,), and the edges' weights.

        Where edges agree better than they claim, none is taken for wrong that is not so by its own standard deviation.
        """
        weight = 1 / sigma**2
        for _ in range(10):
            solution = self.factor(weight).values(value)
            residual = (value - solution[self.second] + solution[self.first]) / sigma
            scale = max(robust_std(residual), 1.0)
            weight = 1 / (sigma**2 * (1 + (residual / (2 * scale)) ** 2))
        return solution, weight

    def common_error(self, edges: Edges, solution: np.ndarray) -> float:
        """Standard deviation of what all patches of an edge have in common, as edges contradict each other by more than
        their patches do; 0: they do not. By the better half of the edges, which would show it.

        solution: (I,)
        """
        spare = len(edges.mean) - len(self.component) + int(self.component.max(initial=-1)) + 1
        if not spare:
            return 0.0
        half = edges.sigma <= np.median(edges.sigma)
        # what the solution takes up of the errors of the edges
        square = self._misclosure(edges, solution)[half] ** 2 * len(edges.mean) / spare
        low, high = 0.0, float(square.max())
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            more = np.median(square / (edges.sigma[half] ** 2 + middle)) > NORMAL**-2
            low, high = (middle, high) if more else (low, middle)
        return float(np.sqrt(low))

    def contradiction(self, edges: Edges, solution: np.ndarray) -> np.ndarray:
        """(I,) float64, at least 1: mean square of the misclosures of edges in their standard deviations, each edge by
        what it would count for the image if none were left out as wrong.

        Where an image is tied by few edges that contradict each other, the robust solution takes a side.
        """
        square = np.minimum((self._misclosure(edges, solution) / edges.sigma) ** 2, _GROSS**2)
        ratio = np.ones(len(self.component))
        for images, by_edges in self.factor(edges.sigma**-2).by_edges():
            variance = (by_edges * edges.sigma[:, None]) ** 2
            ratio[images] = square @ variance / np.maximum(variance.sum(axis=0), 1e-300)
        return np.maximum(ratio, 1.0)

    def _misclosure(self, edges: Edges, solution: np.ndarray) -> np.ndarray:
        """(E,): how far edges are off the solution (I,)."""
        return np.asarray(edges.mean - solution[self.second] + solution[self.first])

    def sigma(
        self, edges: Edges, solution: np.ndarray, weight: np.ndarray, contradiction: np.ndarray
    ) -> np.ndarray:
        """Standard deviation (I,) of each image's value about the mean of its group; inf where it is alone.

        solution: (I,), with edges of weight (E,); contradiction: (I,). Patches on one surface err together; by how much
        the variance grows by that is what the jackknife tells, over blocks of the size that tells more.
        """
        factor, correlations = self.factor(weight), edges.correlations
        own = np.zeros(len(self.component))
        for images, by_edges in factor.by_edges():
            error = by_edges * edges.sigma[:, None]
            own[images] = np.einsum("ei,ei->i", error, correlations @ error)
        joined = np.bincount(self.group)[self.group] > 1
        if not joined.any():
            return np.full(len(self.component), np.inf)
        blocks = [range(BLOCKS), range(BLOCKS, 2 * BLOCKS)]
        small, large = (
            self._jackknife(np.stack([self._without(edges, weight, b) - solution for b in each], axis=1))
            for each in blocks
        )
        most = max(small[joined].mean(), large[joined].mean())
        shared = self._jackknife(factor.values(_by_radiometry(edges)))
        shared += self._held_response(factor, edges, solution) ** 2
        shared += self._centered(factor.values(_by_nearness(edges)[:, None]))[:, 0] ** 2
        if edges.radiometry.vignetting:
            shared += self._centered(factor.values(_FALLOFF_FLOOR * edges.by_radiometry[:, :1]))[:, 0] ** 2
        variance_factor = max(most / own[joined].mean(), 1.0) * contradiction
        return np.where(joined, np.sqrt(own * variance_factor + shared), np.inf)

    def _held_response(self, factor: _Factor, edges: Edges, solution: np.ndarray) -> np.ndarray:
        """(I,): by what values would differ with the response that fits best, but for a power of all, which is open."""
        change, value = self._centered(
            np.stack([factor.values(_by_held_response(edges)), solution], axis=1)
        ).T
        return np.asarray(change - value * (change @ value) / max(value @ value, 1e-12))

    def _without(self, edges: Edges, weight: np.ndarray, block: int) -> np.ndarray:
        """(I,): the solution without the patches of one block. weight: (E,), of the edges with them"""
        rest = 1 - edges.weight_fraction[:, block]
        mean = edges.mean - np.where(rest > _LITTLE, edges.pull[:, block] / np.maximum(rest, _LITTLE), 0.0)
        return self.factor(weight * np.maximum(rest, _LEAST)).values(mean)

    def _jackknife(self, changes: np.ndarray) -> np.ndarray:
        """(I,): variances of changes (I, BLOCKS) without one block each, about the mean of the group."""
        return np.asarray((BLOCKS - 1) / BLOCKS * (self._centered(changes) ** 2).sum(axis=1))

    def _centered(self, values: np.ndarray) -> np.ndarray:
        """Values (I, K) less the mean of their group."""
        count = np.bincount(self.group)
        members = sparse.csr_matrix((np.ones(len(values)), (self.group, np.arange(len(values)))))
        return np.asarray(values - ((members @ values) / count[:, None])[self.group])


_FEWEST_STEPS = 20
"""From image to image within groups, to tell which are usual."""
_MOST_STEP = 1.5
"""Times the largest of these, beyond which a step to another group is not believed."""


def _continued(log_exposure: np.ndarray, component: np.ndarray, group: np.ndarray) -> np.ndarray:
    """(I,): every further component continues from the image before its first one, and so does a group that a single
    block ties to another if exposures never change as that block says.

    Of four such ties along 22 km, two were right to 0.4 %, and two, of patches behind other things, wrong by 36 and 50 %.
    """
    continued = log_exposure.copy()
    for label in range(1, component.max(initial=-1) + 1):
        members = np.flatnonzero(component == label)
        continued[members] += continued[members[0] - 1]
    inside = group[1:] == group[:-1]
    if np.count_nonzero(inside) < _FEWEST_STEPS:
        return continued
    most = _MOST_STEP * np.abs(np.diff(continued))[inside].max()
    for label in range(1, int(group.max()) + 1):
        first = int(np.argmax(group == label))
        step = continued[first] - continued[first - 1]
        if abs(step) > most:
            # groups are numbered by their first images: those behind hang on this one
            continued[group >= label] -= step
    return continued

"""Cholesky of block-sparse normal equations of a path: frames are coupled to those near them, and a few unknowns to all.

In the order of reverse Cuthill-McKee such a Hessian is a band, wider where the path closes a loop, and a border of the
unknowns that all frames share. A band needs no search for an order, and LAPACK works on it in dense tiles: for 1,000
frames that are each coupled to 300 it takes a seventh of the time of sparse LU.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtrtri
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

MOST_BYTES = 3e9
"""Bands larger than this are not made."""
_BORDER_SHARE = 0.5
"""A block coupled to more than this part of all others is in the border."""


@dataclass(frozen=True)
class BandedCholesky:
    """A matrix `[[band, rim], [rim^T, shared]]` in Cholesky factors, its blocks in the order of `inner`, then `border`.

    lower: (width, N), the factor of the band as LAPACK has it; through: (N, n), the band's inverse times the rim;
    rest: (n, n), what is left of `shared` without what the band explains; free: (B, b) bool
    """

    lower: np.ndarray
    inner: np.ndarray
    border: np.ndarray
    rim: np.ndarray
    through: np.ndarray
    rest: np.ndarray
    free: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (B b, n) for right sides (B b, n); zero for unknowns that are not free."""
        right = np.where(self.free.reshape(-1, 1), right, 0.0)
        found = np.zeros_like(right)
        order, edge = self._unknowns(self.inner), self._unknowns(self.border)
        alone = cho_solve_banded((self.lower, True), right[order], check_finite=False)
        if len(edge):
            found[edge] = np.linalg.solve(self.rest, right[edge] - self.rim.T @ alone)
            alone = alone - self.through @ found[edge]
        found[order] = alone
        return found

    def inverse_blocks(self) -> np.ndarray:
        """The diagonal blocks (B, b, b) of the inverse; zero for unknowns that are not free.

        By selected inversion: the inverse only where the factor of the band has entries, which takes a few times as
        long as the factor itself. Source: Takahashi, Fagan and Chen 1973; Erisman and Tinney 1975.
        """
        size = self.free.shape[1]
        found = np.zeros((*self.free.shape, size))
        found[self.inner] = _diagonal_of_inverse(self.lower, size)
        if len(self.border):
            shared = np.linalg.inv(self.rest)
            through = self.through.reshape(len(self.inner), size, -1)
            found[self.inner] += through @ shared @ np.swapaxes(through, 1, 2)
            here = np.arange(len(self.border))
            found[self.border] = shared.reshape(len(here), size, len(here), size)[here, :, here]
        return np.where(self.free[:, :, None] & self.free[:, None], found, 0.0)

    def _unknowns(self, blocks: np.ndarray) -> np.ndarray:
        size = self.free.shape[1]
        return np.asarray((blocks[:, None] * size + np.arange(size)).ravel())


def factor(
    rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, diagonal: np.ndarray, free: np.ndarray
) -> BandedCholesky | None:
    """The factors; None where the matrix is not positive.

    rows, columns: (M,), rows <= columns; blocks: (M, b, b), the upper triangle; diagonal: (B, b), added to the diagonal;
    free: (B, b) bool, unknowns that are not free are zero in every solution.
    Raises MemoryError: the band would be larger than MOST_BYTES.
    """
    count = len(diagonal)
    degree = np.bincount(rows, minlength=count) + np.bincount(columns, minlength=count) - 1
    border = np.flatnonzero(degree > max(_BORDER_SHARE * count, 32)) if count > 64 else np.zeros(0, int)
    if len(border) > 0.1 * count:
        border = np.zeros(0, int)  # all are coupled to many: there is no band
    place, inner = _places(rows, columns, count, border)
    band = _band(rows, columns, blocks, diagonal, free, place, len(inner))
    try:
        lower = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    if not len(border):
        none = np.zeros((lower.shape[1], 0))
        return BandedCholesky(lower, inner, border, none, none, np.zeros((0, 0)), free)
    rim, shared = _border(rows, columns, blocks, diagonal, free, place, border, len(inner))
    through = cho_solve_banded((lower, True), rim, check_finite=False)
    rest = shared - rim.T @ through
    try:
        np.linalg.cholesky(rest)
    except np.linalg.LinAlgError:
        return None
    return BandedCholesky(lower, inner, border, rim, through, rest, free)


def _diagonal_of_inverse(lower: np.ndarray, size: int) -> np.ndarray:
    """The diagonal blocks (N / b, b, b) of the inverse of L L^T; lower: (width, N), L as a band.

    In tiles at least as wide as the band, L has none but diagonal tiles and those next below: with G = L[k+1, k] L[k,
    k]^-1 the tiles Z of the inverse follow from the last one up, Z[k, k] = (L[k, k] L[k, k]^T)^-1 + G^T Z[k+1, k+1] G.
    """
    width, count = lower.shape
    tile = size * -(-max(width, 8 * size) // size)
    found = np.zeros((count // size, size, size))
    starts = range(0, count, tile)
    later = np.zeros((0, 0))
    for start in reversed(starts):
        stop = min(start + tile, count)
        inverse, _ = dtrtri(_tile(lower, slice(start, stop), slice(start, stop)), lower=1, overwrite_c=1)
        tile_inverse = inverse.T @ inverse
        if len(later):
            below = _tile(lower, slice(stop, stop + len(later)), slice(start, stop)) @ inverse
            tile_inverse += below.T @ later @ below
        later = tile_inverse
        here = np.arange((stop - start) // size)
        found[start // size : stop // size] = later.reshape(len(here), size, len(here), size)[here, :, here]
    return found


def _tile(lower: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """Rows and columns of a lower triangular band (width, N), dense, in columns as LAPACK has it."""
    found = np.zeros((rows.stop - rows.start, columns.stop - columns.start), order="F")
    for place, column in enumerate(range(columns.start, columns.stop)):
        first, last = max(column, rows.start), min(column + len(lower), rows.stop)
        if first < last:
            found[first - rows.start : last - rows.start, place] = lower[
                first - column : last - column, column
            ]
    return found


def _places(
    rows: np.ndarray, columns: np.ndarray, count: int, border: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where each block is in the band, (B,), -1 for those in the border; and the blocks of the band in order."""
    inside = np.ones(count, bool)
    inside[border] = False
    pair = inside[rows] & inside[columns]
    index = np.cumsum(inside) - 1
    graph = coo_matrix(
        (np.ones(pair.sum(), np.int8), (index[rows[pair]], index[columns[pair]])), shape=(inside.sum(),) * 2
    ).tocsr()
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    inner = np.flatnonzero(inside)[order]
    place = np.full(count, -1)
    place[inner] = np.arange(len(inner))
    return place, inner


def _band(
    rows: np.ndarray,
    columns: np.ndarray,
    blocks: np.ndarray,
    diagonal: np.ndarray,
    free: np.ndarray,
    place: np.ndarray,
    inner: int,
) -> np.ndarray:
    """The lower band (width, N), as LAPACK wants it: entry (i, j) in row i - j, column j."""
    size = diagonal.shape[1]
    mine = (place[rows] >= 0) & (place[columns] >= 0)
    first, second = place[rows[mine]], place[columns[mine]]
    reach = int(np.abs(first - second).max(initial=0))
    width = (reach + 1) * size
    if 8.0 * width * inner * size > MOST_BYTES:
        raise MemoryError(f"a band of {8e-9 * width * inner * size:.1f} GB")
    band = np.zeros((inner * size, width)).T  # as LAPACK has it in memory, so that it is factored in place
    own = first == second
    for a in range(size):
        for b in range(size):
            i, j = first * size + a, second * size + b
            keep = ~own | (a >= b)
            low, high = np.minimum(i, j)[keep], np.maximum(i, j)[keep]
            # one entry of all blocks at a time: a copy of all of them would be as large as the band
            values = np.where(free[rows, a] & free[columns, b], blocks[:, a, b], 0.0)
            band[high - low, low] += values[mine][keep]
    where = place >= 0
    added = np.where(free, diagonal, 1.0)[where]
    band[0, (place[where][:, None] * size + np.arange(size)).ravel()] += added.ravel()
    return band


def _border(
    rows: np.ndarray,
    columns: np.ndarray,
    blocks: np.ndarray,
    diagonal: np.ndarray,
    free: np.ndarray,
    place: np.ndarray,
    border: np.ndarray,
    inner: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What couples the band to the border, (N, n), and the border itself, (n, n)."""
    size, number = diagonal.shape[1], np.full(len(place), -1)
    number[border] = np.arange(len(border))
    rim = np.zeros((inner, size, len(border), size))
    shared = np.zeros((len(border), size, len(border), size))
    for row, column, block in zip(rows, columns, blocks, strict=True):
        if number[row] < 0 and number[column] < 0:
            continue
        masked = block * free[row][:, None] * free[column][None]
        if number[row] >= 0 and number[column] >= 0:
            shared[number[row], :, number[column]] = masked
            shared[number[column], :, number[row]] = masked.T
        elif number[column] >= 0:
            rim[place[row], :, number[column]] = masked
        else:
            rim[place[column], :, number[row]] = masked.T
    total = len(border) * size
    corner = shared.reshape(total, total)
    corner[np.diag_indices(total)] += np.where(free, diagonal, 1.0)[border].ravel()
    return rim.reshape(inner * size, total), corner

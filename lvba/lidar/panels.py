"""How the low-rank part of the Hessian lies in memory."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, identity

from lvba.kernels import lidar as kernel
from lvba.kernels.lidar import TILE
from lvba.lidar.plane_feature import PlaneFeatures


@dataclass(frozen=True)
class Panels:
    """A panel for each feature and tile of `TILE` neighboring scans that see it: P panels, tile after tile.

    starts: (T + 1,) int64, tile t owns panels starts[t] to starts[t + 1], ascending in feature
    feature: (P,) int32
    seen: (P,) int64, bit s is set where scan s of the tile sees the feature
    panel: (O,) int32, the panel of each observation
    """

    starts: np.ndarray
    feature: np.ndarray
    seen: np.ndarray
    panel: np.ndarray

    @property
    def arrays(self) -> kernel.Panels:
        """As kernels take them."""
        return kernel.Panels(self.starts, self.feature, self.seen)


def pack(features: PlaneFeatures, scans: int) -> Panels:
    """The panels of the features' observations by `scans` scans."""
    return pack_observations(features.feature, features.scan, scans)


def pack_observations(feature: np.ndarray, scan: np.ndarray, scans: int) -> Panels:
    """The panels of observations of features (O,) by scans (O,), ascending by feature, then by scan, below `scans`.

    feature, scan: (O,) int32
    """
    tile = scan // TILE
    new = np.ones(len(tile), bool)
    new[1:] = (feature[1:] != feature[:-1]) | (tile[1:] != tile[:-1])
    first = np.flatnonzero(new)
    order = np.argsort(tile[first], kind="stable")
    place = np.empty(len(first), np.int32)
    place[order] = np.arange(len(first), dtype=np.int32)
    seen = np.bitwise_or.reduceat(np.int64(1) << (scan % TILE), first) if len(first) else first
    starts = np.searchsorted(tile[first][order], np.arange(-(-scans // TILE) + 1))
    return Panels(starts, feature[first][order], seen[order], place[np.cumsum(new) - 1])


def pairs_of_tiles(panels: Panels) -> np.ndarray:
    """(Q, 2) int64: tiles that see a feature together, the first not after the second, each tile with itself; near ones
    first, which have more in common than far ones.
    """
    tiles = len(panels.starts) - 1
    sees = csr_matrix(
        (np.ones(len(panels.feature), np.int32), panels.feature, panels.starts),
        shape=(tiles, int(panels.feature.max(initial=-1)) + 1),
    )
    together = (sees @ sees.T + identity(tiles, np.int32, "csr")).tocoo()
    first, second = together.row.astype(np.int64), together.col.astype(np.int64)
    keep = first <= second
    first, second = first[keep], second[keep]
    order = np.lexsort((first, second - first))
    return np.stack([first[order], second[order]], axis=1)


def fill(panels: Panels, features: PlaneFeatures, column: np.ndarray) -> np.ndarray:
    """W (P, 3, 6 TILE) of one column for each feature, of which each observation has 6 numbers: column (O, 6).

    column: (O, 6) float64
    """
    w = np.zeros((len(panels.feature), 3, 6 * TILE))
    place = 6 * (features.scan % TILE)[:, None] + np.arange(6)
    w[panels.panel[:, None], 0, place] = column
    return w


def by_scan(features: PlaneFeatures, scans: int) -> kernel.ByScan:
    """The observations of each of `scans` scans, ascending within a scan."""
    # numbers of two bytes are sorted several times as fast
    small = np.int16 if scans <= np.iinfo(np.int16).max else np.int32
    order = np.argsort(features.scan.astype(small), kind="stable")
    return kernel.ByScan(np.searchsorted(features.scan[order], np.arange(scans + 1)), order)

"""Colors of maps of simulated scenes, of which it is known what every camera truly sees."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lvba import geometry
from lvba.io.dataset import load_scan, open_dataset
from lvba.io.reference import read_reference
from lvba.kernels import zbuffer
from lvba.products import cloud as clouds
from lvba.products import colorize, map_file
from lvba.products.cloud import Cloud
from lvba.products.recorded_images import views_of
from lvba.products.views import Views
from lvba.simulate import cabinet, known, simulate

OFF_M = 0.06
"""Points further than this from what their beam met are no measurement of it."""
STEEP = np.cos(np.radians(80))


@dataclass(frozen=True)
class Seen:
    """The map at true poses, and what is known of its points: rectangle (K,), place (K, 3), m, scene frame."""

    cloud: Cloud
    kept: np.ndarray
    views: Views
    scene: known.KnownScene
    scene_from_world: np.ndarray
    quad: np.ndarray
    place: np.ndarray

    @property
    def points(self):
        return self.cloud.points_world[self.kept]

    def blended(self):
        return colorize.blended(self.points, self.views, origins=self.cloud.origins(self.kept))


def made(folder, scene, lidar, beams):
    simulate(scene, folder, frames=36, seed=3, width=320, height=240, points_per_scan=beams, lidar=lidar)
    dataset, true, facts = open_dataset(folder), read_reference(folder / "reference"), known.read(folder)
    scans, cameras = true.scans.world_from_sensor.copy(), true.images.world_from_sensor.copy()
    scans[:, :3, 3] -= dataset.origin
    cameras[:, :3, 3] -= dataset.origin
    cloud = clouds.assemble(
        lambda s: load_scan(dataset, s).points, scans, dataset.scans.times, lambda *_: None, dataset.sensor_position_scan
    )  # fmt: skip
    exposure = np.log(true.exposures.relative)
    views = replace(views_of(dataset), world_from_camera=cameras, log_exposure=exposure)
    kept = clouds.thin(cloud.points_world, map_file.pixel_footprint(cloud, views, views.camera))
    scan, points = cloud.scan_of(kept), cloud.points_world[kept].astype(float)
    quad, place, off = np.full(len(kept), -1), np.zeros((len(kept), 3)), np.full(len(kept), np.inf)
    for s in range(len(scans)):
        measured = geometry.transform_points(geometry.inverse(scans[s]), points[scan == s])
        quad[scan == s], place[scan == s], off[scan == s] = facts.surface(s, measured)
    quad[off >= OFF_M] = -1
    return Seen(cloud, kept, views, facts, facts.scene_from_scan[0] @ geometry.inverse(scans[0]), quad, place)


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return made(tmp_path_factory.mktemp("cabinet"), "cabinet", "non_repetitive", 12_000)


def in_image(seen, image, points):
    """Column, row and depth of points (K, 3), and whether they are in the image."""
    camera, pose = seen.views.camera, seen.views.world_from_camera[image]
    local = geometry.transform_points(geometry.inverse(pose), points)
    z = np.maximum(local[:, 2], 0.05)
    u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
    inside = (local[:, 2] > 0.05) & (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
    column, row = np.where(inside, u + 0.5, 0).astype(int), np.where(inside, v + 0.5, 0).astype(int)
    return column, row, local[:, 2], inside & seen.views.mask[row, column]


def truly_seen(seen, some):
    """Whether any camera sees points of these numbers at most 80 degrees off the normal, and whether from any side."""
    well, at_all = np.zeros(len(some), bool), np.zeros(len(some), bool)
    normal, place = seen.scene.world.normal[seen.quad[some]], seen.place[some]
    scans = seen.scene.scene_from_scan[seen.cloud.scan_of(seen.kept[some]), :3, 3]
    normal = normal * np.sign(((scans - place) * normal).sum(1))[:, None]
    for image, pose in enumerate(seen.views.world_from_camera):
        _, _, _, inside = in_image(seen, image, seen.points[some].astype(float))
        center = (seen.scene_from_world @ pose)[:3, 3]
        ray = place - center
        distance = np.linalg.norm(ray, axis=1)
        part, _ = seen.scene.caster.cast(center, ray)
        cosine = -(normal * ray).sum(1) / distance
        clear = inside & (part * distance > distance - 0.02) & (cosine > 0)
        well |= clear & (cosine > STEEP)
        at_all |= clear
    return well, at_all


@pytest.mark.parametrize(
    ("scene", "least", "most"),
    [("cabinet", 0.98, 0.002), ("street", 0.9, 0.025)],
    ids=["cabinet", "street"],
)
def test_what_cameras_see_well_has_color_and_what_none_sees_has_none(scene, least, most, request, tmp_path):
    """Not all on a street: next to the edge of what is nearer, no color is to be trusted."""
    seen = request.getfixturevalue("box") if scene == "cabinet" else made(tmp_path, scene, "spinning", 6000)
    some = np.flatnonzero(seen.quad >= 0)[::5]
    well, at_all = truly_seen(seen, some)
    colored = seen.blended().views[some] > 0
    assert well.mean() > 0.4
    assert colored[well].mean() > least
    assert (colored & ~at_all).mean() < most


def shares_of_floor(seen, colors):
    """The share of the colored points with the floor's color: of the cabinet's sides, and of those next to its edges."""
    half, side = np.array(cabinet.SIZE_M) / 2, np.isin(seen.quad, cabinet.SIDES)
    wide, place = np.isin(seen.quad, cabinet.SIDES[:2]), seen.place
    to_edge = np.where(wide, half[0] - np.abs(place[:, 0]), half[1] - np.abs(place[:, 1]))
    edge = side & ((to_edge < 0.05) | (2 * half[2] - place[:, 2] < 0.05))
    level = colors.sum(1)
    chroma = colors / np.maximum(level, 1e-9)[:, None]
    floors, sides = (style[:3] / style[:3].sum() for style in (cabinet.FLOOR_STYLE, cabinet.CABINET_STYLE))
    wrong = np.linalg.norm(chroma - floors, axis=1) < 0.5 * np.linalg.norm(floors - sides)
    return [wrong[where & (level > 0)].mean() for where in (side, edge)]


def by_distance_alone(seen):
    """Colors (K, 3) as once: 1 / distance^2, up to 104 degrees off the normal, hidden by more than 0.15 m + 2 %."""
    side = np.isin(seen.quad, cabinet.SIDES)
    points, views = seen.points, seen.views
    blocks = clouds.sort_into_blocks(points)
    ordered = np.ascontiguousarray(points[blocks.order].T)
    surface = np.empty((len(points), 8), np.float32)
    surface[blocks.order] = clouds.surfaces(ordered, blocks, seen.cloud.origins(seen.kept), 0.5 * np.pi)
    depths = zbuffer.seen_depths(blocks.holding(ordered), views.poses, views.intrinsics, 4, *views.mask.shape)
    mine = np.flatnonzero(side)
    rank, gray = np.zeros((len(views), len(mine))), np.zeros((len(views), len(mine), 3))
    for image, pose in enumerate(views.world_from_camera):
        column, row, depth, inside = in_image(seen, image, points[mine].astype(float))
        ray = points[mine] - pose[:3, 3]
        square = (ray**2).sum(1)
        facing = -(surface[mine, :3] * ray).sum(1) > -0.25 * np.sqrt(square)
        open_to_it = depth <= 1.02 * depths[image, row // 4, column // 4] + 0.15
        rank[image] = inside * facing * open_to_it / square
        gray[image] = views.load(image)[row, column] / np.exp(views.log_exposure[image])
    rank[rank < np.sort(rank, axis=0)[-8]] = 0
    colors = np.zeros((len(points), 3))
    colors[mine] = (rank[..., None] * gray).sum(0) / np.maximum(rank.sum(0), 1e-9)[:, None]
    return colors


def test_sides_of_a_thin_cabinet_do_not_carry_the_color_of_its_floor(box):
    now, once = shares_of_floor(box, box.blended().radiance), shares_of_floor(box, by_distance_alone(box))
    for share, before, most in zip(now, once, (0.0085, 0.04), strict=True):
        assert share < most < before, (now, once)

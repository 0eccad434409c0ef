"""Coloring, rendering and judging, end to end on a box with known radiance."""

from dataclasses import replace

import box_world
import numpy as np
import pytest

from lvba import geometry
from lvba.products import cloud as clouds
from lvba.products import colorize, evaluate, render


@pytest.fixture(scope="module")
def world():
    return box_world.make()


@pytest.fixture(scope="module")
def scores(world):
    shaken = geometry.retract(
        world.world_from_camera, np.random.default_rng(1).normal(0, [0.02] * 3 + [0.05] * 3, (6, 6))
    )
    states = {
        "true": evaluate.State(world.cloud(), world.views()),
        "shaken": evaluate.State(world.cloud(), world.views(shaken)),
        "dull": evaluate.State(world.cloud(), world.views(log_exposure=np.zeros(6))),
    }
    return evaluate.evaluate(states)


def test_assembled_clouds_leave_out_points_that_are_not_finite(world):
    scans = [scan.copy() for scan in world.scans]
    scans[1][3] = np.nan
    cloud = clouds.assemble(lambda s: scans[s], world.world_from_scan, np.arange(6.0))
    assert cloud.scan_offsets[2] - cloud.scan_offsets[1] == len(scans[1]) - 1
    expected = world.cloud().points_world[: len(scans[0])]
    np.testing.assert_allclose(cloud.points_world[: len(scans[0])], expected, atol=1e-5)


def test_paper_colors_are_the_radiance_of_the_image_nearest_in_time(world):
    cloud = world.cloud()
    colors = colorize.paper(cloud, world.views())
    colored = colors.source >= 0
    assert 0.2 < colored.mean() < 1
    scan = np.repeat(np.arange(6), np.diff(cloud.scan_offsets))
    np.testing.assert_array_equal(colors.source[colored], scan[colored])
    error = colors.radiance(world.log_exposure)[colored] - box_world.texture(cloud.points_world[colored])
    assert np.sqrt((error**2).mean()) < 5


def test_states_colored_together_get_the_colors_of_each_by_itself(world):
    moved = geometry.retract(world.world_from_camera, np.full((6, 6), 0.01))
    states = [(world.cloud(), world.views()), (world.cloud(), world.views(moved))]
    for held_out in (None, np.array([2])):
        for together, (cloud, views) in zip(colorize.paper_each(states, held_out), states, strict=True):
            alone = colorize.paper(cloud, views, held_out)
            np.testing.assert_array_equal(together.gray, alone.gray)
            np.testing.assert_array_equal(together.source, alone.source)
        assert not np.array_equal(together.gray, colorize.paper(*states[0], held_out).gray)


def test_held_out_images_color_nothing(world):
    colors = colorize.paper(world.cloud(), world.views(), held_out=np.array([2]))
    assert 2 not in colors.source
    assert {1, 3} <= set(colors.source)


def test_true_poses_and_exposures_beat_wrong_ones(scores):
    for key in (
        "psnr",
        "psnr_leave_one_out",
        "ssim_leave_one_out",
        "psnr_common",
        "psnr_compared",
        "ssim_common",
        "ssim_compared",
        "psnr_full",
    ):
        assert getattr(scores["true"], key) > getattr(scores["shaken"], key), key
        assert getattr(scores["true"], key) > getattr(scores["dull"], key), key
    assert scores["true"].psnr_leave_one_out > 24


def test_common_pixels_are_those_of_every_state(scores):
    assert len({score.coverage_common for score in scores.values()}) == 1
    assert all(s.coverage_common <= s.coverage_leave_one_out <= s.coverage for s in scores.values())


def test_states_apart_take_no_pixels_from_the_comparison_of_the_others(world):
    rng = np.random.default_rng(1)
    near, far = (
        geometry.retract(world.world_from_camera, rng.normal(0, [size] * 3 + [2 * size] * 3, (6, 6)))
        for size in (0.002, 0.05)
    )
    states = {
        name: evaluate.State(world.cloud(), world.views(poses))
        for name, poses in (("true", world.world_from_camera), ("near", near), ("far", far))
    }
    scores = evaluate.evaluate(states, apart={"far"})
    two = evaluate.evaluate({name: states[name] for name in ("true", "near")})
    for name in ("true", "near"):
        assert scores[name].psnr_compared == two[name].psnr_common == two[name].psnr_compared
        assert scores[name].ssim_compared == two[name].ssim_common
        assert scores[name].coverage_common < scores[name].coverage_compared
    assert np.isnan(scores["far"].psnr_compared)
    assert np.isfinite(scores["far"].psnr_common)


def test_facts_are_plain_numbers(scores):
    facts = scores["true"].facts()
    assert facts["psnr_held_out"] is None
    assert len(facts["per_image"]["psnr"]) == 6
    assert facts["psnr"] == pytest.approx(np.mean(facts["per_image"]["psnr"]))


def test_held_out_images_are_judged_apart(world):
    state = evaluate.State(world.cloud(), world.views())
    scores = evaluate.evaluate({"true": state}, held_out=np.array([1, 4]))["true"]
    by_image = scores.per_image["psnr_leave_one_out"]
    assert scores.psnr_held_out == pytest.approx(by_image[[1, 4]].mean())
    assert scores.psnr_leave_one_out == pytest.approx(by_image[[0, 2, 3, 5]].mean())
    # all their points are of other images: the same pixels but for those beside or behind something nearer
    np.testing.assert_allclose(scores.per_image["psnr"][[1, 4]], by_image[[1, 4]], atol=0.4)


def test_a_wall_that_one_image_alone_colored_hides_what_other_images_saw_behind_it(world):
    rng = np.random.default_rng(0)
    near, far = (
        rng.uniform(-1, 1, (count, 3)) * [edge, edge, 0] + [0, 0, edge]
        for count, edge in ((1500, 1), (9000, 3))
    )
    source = np.repeat([0, 1], [len(near), len(far)]).astype(np.int32)
    colors = colorize.PaperColors(gray=np.full((len(source), 3), 100, np.float32), source=source)
    cloud = render.colored_cloud(np.concatenate([near, far]).astype(np.float32), colors)
    poses = np.stack([np.eye(4), geometry.exp(np.array([0, 0, 0, 0, 0, 1.5]))])
    views = box_world.BoxWorld(poses, np.zeros(2), world.pictures[:2], [], poses).views()
    entries = render.nearest(cloud, views, 0)
    depth = render.depth(entries)
    assert ((depth[render.ALL] > 2) & np.isfinite(depth[render.ALL])).mean() > 0.05
    assert np.isfinite(depth[render.OTHERS]).mean() < 0.01
    # from behind the wall the far one is seen, whoever colored it
    assert np.isfinite(render.depth(render.nearest(cloud, views, 1, guard_images=0))[render.ALL]).mean() > 0.5


def test_an_image_without_neighbors_in_view_is_not_judged_by_itself(world):
    alone = box_world.BoxWorld(
        world.world_from_camera[:1],
        world.log_exposure[:1],
        world.pictures[:1],
        world.scans[:1],
        world.world_from_scan[:1],
    )
    scores = evaluate.evaluate({"one": evaluate.State(alone.cloud(), alone.views())})["one"]
    assert scores.coverage > 0.5
    assert scores.coverage_leave_one_out == 0
    assert np.isnan(scores.psnr_leave_one_out)


def test_blended_colors_come_close_to_the_true_radiance(world):
    cloud = world.cloud()
    colors = colorize.blended(cloud.points_world, world.views())
    seen = colors.views > 0
    assert seen.mean() > 0.4
    assert colors.views.max() > 2
    error = colors.radiance[seen] - box_world.texture(cloud.points_world[seen])
    assert np.sqrt((error**2).mean()) < 4
    single = colorize.paper(cloud, world.views())
    both = seen & (single.source >= 0) & (colors.views > 2)
    truth = box_world.texture(cloud.points_world[both])
    assert (
        np.abs(colors.radiance[both] - truth).mean()
        < 1.1 * np.abs(single.radiance(world.log_exposure)[both] - truth).mean()
    )
    assert (colors.radiance[~seen] == 0).all()


def test_hidden_points_take_no_color_from_what_hides_them(world):
    board = np.random.default_rng(0).uniform(-0.3, 0.3, (4000, 3)) * [1, 1, 0] + [0, 0, 0.8]
    pose = np.eye(4)[None]
    points = np.concatenate([board, np.array([[0.0, 0.0, 1.4], [0.0, 0.0, 0.85], [0.9, 0.0, 1.4]])]).astype(
        np.float32
    )
    views = box_world.BoxWorld(pose, np.zeros(1), world.pictures[:1], [], pose).views()
    colors = colorize.blended(points, views)
    assert colors.views[-3] == 0
    assert colors.views[-2] == 1
    assert colors.views[-1] == 1


@pytest.mark.parametrize("most", [20_000, 200_000])
def test_points_colored_in_turns_get_the_colors_of_all_at_once(world, monkeypatch, most):
    cloud = world.cloud()
    at_once = colorize.blended(cloud.points_world, world.views())
    steps = []
    monkeypatch.setattr(colorize, "_MOST_SAMPLES", most)
    in_turns = colorize.blended(cloud.points_world, world.views(), progress=lambda *done: steps.append(done))
    for name in ("radiance", "views", "spread"):
        np.testing.assert_array_equal(getattr(in_turns, name), getattr(at_once, name))
    assert steps[-1][2] > 6
    assert [done for _, done, _ in steps] == sorted(done for _, done, _ in steps)
    assert steps[-1][1] == steps[-1][2]


def test_spans_hold_all_blocks_once_and_so_many_points_at_most(world):
    blocks = clouds.sort_into_blocks(world.cloud().points_world)
    for most in (1, 500, 10**9):
        spans = blocks.spans(most)
        assert [span.start for span in spans] == [0, *(span.stop for span in spans[:-1])]
        assert spans[-1].stop == len(blocks.spheres)
        for span in spans:
            held = blocks.start[span.stop] - blocks.start[span.start]
            assert held <= most or span.stop == span.start + 1


def test_saturated_samples_are_left_out_where_there_are_others(world):
    pictures = world.pictures.copy()
    pictures[0] = 255
    bright = box_world.BoxWorld(
        np.repeat(world.world_from_camera[:1], 3, axis=0), np.zeros(3),
        np.stack([pictures[0], world.pictures[0], world.pictures[0]]),
        world.scans[:1], world.world_from_scan[:1],
    )  # fmt: skip
    colors = colorize.blended(bright.cloud().points_world, bright.views())
    seen = colors.views > 0
    assert (colors.views[seen] == 2).all()
    assert (colors.spread[seen] < 1e-3).all()
    only = box_world.BoxWorld(
        pose := world.world_from_camera[:1], np.zeros(1), pictures[:1], world.scans[:1], pose
    )
    colors = colorize.blended(only.cloud().points_world, only.views())
    np.testing.assert_allclose(colors.radiance[colors.views > 0], 255, rtol=1e-5)


def test_renderings_carry_depth_and_clip_like_a_sensor(world):
    views = world.views(log_exposure=np.array([0, 0, 3.0, 0, 0, 0]))
    (cloud,) = evaluate.color_by_paper([evaluate.State(world.cloud(), views)])
    entries = render.nearest(cloud, views, 2)
    rendering, depth = render.shade(entries, cloud, views.log_exposure, 2), render.depth(entries)
    assert rendering.color.max() == 255
    assert (rendering.color[~rendering.covered] == 0).all()
    assert np.isinf(depth[~rendering.covered]).all()
    assert (depth[rendering.covered] < 7).all()


def test_states_of_one_geometry_score_as_when_judged_alone(world, scores):
    alone = evaluate.evaluate({"dull": evaluate.State(world.cloud(), world.views(log_exposure=np.zeros(6)))})[
        "dull"
    ]
    shared = evaluate.State(world.cloud(), world.views())
    dull = evaluate.State(shared.cloud, replace(shared.views, log_exposure=np.zeros(6)))
    together = evaluate.evaluate({"true": shared, "dull": dull}, entropies={"true": 1.5})
    for name in ("psnr", "ssim_leave_one_out", "coverage"):
        np.testing.assert_array_equal(together["dull"].per_image[name], alone.per_image[name])
    assert together["true"].psnr == pytest.approx(scores["true"].psnr)
    assert together["dull"].map_entropy == 1.5


def test_each_state_is_compared_with_its_own_images_where_two_lenses_leave_one_pinhole(world):
    """A lens that was refined leaves other undistorted images, and often the same focal lengths."""
    calibrated, refined = world.views(), world.views()
    other = np.roll(world.pictures, 3, axis=2)
    refined = replace(refined, load=lambda i: other[i])
    states = {
        name: evaluate.State(world.cloud(), views)
        for name, views in (("calibrated", calibrated), ("refined", refined))
    }
    together = evaluate.evaluate(states)
    for name, state in states.items():
        alone = evaluate.evaluate({name: state})[name]
        assert together[name].psnr == alone.psnr
        assert together[name].psnr_leave_one_out == alone.psnr_leave_one_out
    assert together["calibrated"].psnr != together["refined"].psnr


@pytest.mark.parametrize(("enough", "judged"), [(True, [0, 2, 5]), (False, [0, 1, 2, 3, 4, 5])])
def test_the_rest_of_the_images_is_judged_only_where_the_first_do_not_do(world, scores, enough, judged):
    asked = []
    state = evaluate.State(world.cloud(), world.views())

    def steps(so_far):
        asked.append(list(so_far["true"].images))
        return enough

    found = evaluate.evaluate({"true": state}, enough=steps, few=3)["true"]
    assert asked == [[0, 2, 5]]
    assert list(found.images) == judged
    own = found.per_image["psnr_leave_one_out"]
    np.testing.assert_array_equal(own, scores["true"].per_image["psnr_leave_one_out"][judged])
    assert found.psnr_leave_one_out == pytest.approx(own.mean())


def test_brief_states_get_the_same_leave_one_out_psnr(world, scores):
    states = {"true": evaluate.State(world.cloud(), world.views())}
    brief = evaluate.evaluate(states, brief=["true"])["true"]
    assert brief.psnr_leave_one_out == scores["true"].psnr_leave_one_out
    assert brief.coverage == scores["true"].coverage
    assert np.isnan(brief.ssim)
    assert np.isnan(brief.psnr)


@pytest.mark.parametrize("settings", [{"splat_px": 2}, {"splat_px": 0}])
def test_bad_render_settings_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        render.RenderConfig(**settings)


def test_blended_colors_can_be_judged_with_one_image_left_out(world):
    state = evaluate.State(world.cloud(), world.views())
    scores = evaluate.evaluate({"true": state}, colors="blended")["true"]
    cloud = render.blended_cloud(state.cloud, state.views, colorize.ColorizeConfig())
    for i in (0, 3):
        # left out by hand: colored anew without the image
        others = render.blended_cloud(state.cloud, state.views, colorize.ColorizeConfig(), np.array([i]))
        expected = render.render(others, state.views, i)
        found = render.render(cloud, state.views, i)
        # but for what lies beside or behind something nearer: much of so small an image
        covered = found.covered[render.OTHERS]
        assert expected.covered[render.ALL][covered].all()
        assert covered.sum() > 0.85 * expected.covered[render.ALL].sum()
        np.testing.assert_allclose(
            found.color[render.OTHERS][covered], expected.color[render.ALL][covered], atol=0.01
        )
    assert scores.psnr_leave_one_out > 24
    with pytest.raises(ValueError, match="guard_images"):
        render.render(cloud, state.views, 0, guard_images=1)

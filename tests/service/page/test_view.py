"""`lvba view` in a real browser: a result of the command line, with and without what a viewer needs in its folder."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request

import pytest
from page_browser import NAME, Watched, at_rest, colors_of, new_picture


@pytest.fixture
def result(served, job, tmp_path):
    """The result of a run, as `lvba fetch` would bring it home."""
    return shutil.copytree(served.data / "jobs" / job / "out", tmp_path / NAME)


@contextlib.contextmanager
def viewing(*words, temporary):
    """A process of `lvba view`, and its address; ended by Ctrl-C, which is no failure."""
    command = [sys.executable, "-m", "service.cli", "view", *map(str, words), "--no-browser"]
    environment = {**os.environ, "TMPDIR": str(temporary)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield process.stdout.readline().strip().rstrip("/")
        finally:
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
        assert process.returncode == 0, said
        assert "Traceback" not in said


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def open_result(browser, url):
    watched = Watched(browser, url)
    watched.page.goto(url)
    watched.page.get_by_role("heading", level=1, name=NAME).wait_for()
    watched.page.wait_for_function(
        "() => /^[1-9]/.test(document.querySelector('.cloud-status')?.textContent ?? '')"
    )
    return watched


@pytest.mark.parametrize("kept", [True, False], ids=["made by the run", "made for the occasion"])
def test_a_result_is_shown_and_nothing_is_written(browser, result, tmp_path, kept):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    if not kept:
        shutil.rmtree(result / "cloud")
        shutil.rmtree(result / "frames")
    before = contents(result)
    with viewing(result, temporary=temporary) as url:
        watched = open_result(browser, url)
        page = watched.page
        assert colors_of(at_rest(page.get_by_role("application", name="Map in 3D"))) > 1000
        page.get_by_role("button", name="Compare photographs").click()
        page.wait_for_function(
            "() => document.querySelectorAll('.slider img').length === 2 && "
            "[...document.querySelectorAll('.slider img')].every((one) => one.naturalWidth > 0)"
        )
        assert page.get_by_role("img", name="PSNR").count() == 1
        with page.expect_download() as download:
            page.get_by_role("link", name="map.ply").click()
        assert download.value.path().read_bytes() == (result / "map.ply").read_bytes()
        of_report = json.loads((result / "report.json").read_text())
        check_verdict(page, of_report)
        check_coloring(page)
        # one result: nothing of jobs
        assert page.get_by_role("navigation").count() == 0
        watched.accessible()
        watched.check()
        watched.context.close()
    assert contents(result) == before
    assert list(temporary.iterdir()) == []


def check_verdict(page, report):
    """The word and the millimeters of report.json stand at the top, above the map."""
    box = page.get_by_role("region", name="Verdict")
    verdict, expected, planes = report["verdict"], report["expected_error"], report["planes"]
    assert verdict["level"].capitalize() in box.locator(".level").inner_text()
    box.get_by_text(verdict["summary"]).wait_for()
    for reason in verdict["reasons"]:
        assert box.get_by_text(reason["mend"]).count() >= 1
    shown = box.inner_text()
    for part in ("map", "scans", "cameras"):
        if expected[part] is not None:
            assert millimeters(expected[part]["position_m"]) in shown
    assert millimeters(planes["thickness_before_m"]) in shown
    assert millimeters(planes["thickness_after_m"]) in shown
    assert box.bounding_box()["y"] < page.locator(".cloud").bounding_box()["y"]
    assert page.get_by_role("img", name="Scans: scans on average").count() == 1


def millimeters(meters):
    value = 1000 * meters
    return f"{value:.{2 if value < 1 else 1 if value < 10 else 0}f} mm"


def check_coloring(page):
    canvas = page.get_by_role("application", name="Map in 3D")
    colored = at_rest(canvas)
    page.get_by_label("Color by").select_option("error")
    new_picture(canvas, [colored])
    assert page.get_by_role("img", name=re.compile("Expected error from 0.* mm$")).count() == 1


def test_a_result_of_an_earlier_version_is_shown_without_a_verdict(browser, result, tmp_path):
    report = json.loads((result / "report.json").read_text())
    for key in ("verdict", "expected_error", "planes", "alarms", "odometry"):
        report.pop(key, None)
    (result / "report.json").write_text(json.dumps(report))
    facts = json.loads((result / "cloud" / "cloud.json").read_text())
    del facts["scans"]["error"], facts["images"]["error"]
    (result / "cloud" / "cloud.json").write_text(json.dumps(facts))
    with viewing(result, temporary=tmp_path) as url:
        watched = open_result(browser, url)
        watched.page.get_by_role("list", name="The input and the result").wait_for()
        assert watched.page.get_by_role("region", name="Verdict").count() == 0
        watched.check()
        watched.context.close()


def test_only_the_result_is_given_out_and_only_to_who_may_ask(result, tmp_path):
    (tmp_path / "secret").write_text("of another")
    (result / "lidar_poses.txt").unlink()
    (result / "lidar_poses.txt").symlink_to(tmp_path / "secret")
    (result / "stages").mkdir(exist_ok=True)
    (result / "stages" / "made").write_text("by a stage")
    base = "/v1/result/results/"
    with viewing(result, temporary=tmp_path) as url:
        for path in ("../secret", "%2e%2e/secret", "lidar_poses.txt", "stages/made"):
            assert status(url + base + path) in (400, 404), path
        assert status(url + base + "report.json") == 200
        assert status(url + base + "report.json", method="DELETE") == 405
        # a page of anybody that calls this address by a name of its own
        assert status(url + base + "report.json", Host="evil.example") == 403


def status(url, method="GET", **headers):
    request = urllib.request.Request(url, method=method, headers=headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_an_octree_of_another_map_is_not_shown_for_this_one(result, tmp_path):
    """A run made again without --viewer leaves the octree of the earlier one beside the new map."""
    from lvba.products import lod

    assert lod.is_of(result / "map.ply", result / "cloud")
    content = bytearray((result / "map.ply").read_bytes())
    content[-40] ^= 1
    (result / "map.ply").write_bytes(content)
    assert not lod.is_of(result / "map.ply", result / "cloud")

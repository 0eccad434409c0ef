"""The page in a real browser before a real service: from an upload to the map on the screen and the files at home."""

import hashlib

import pytest
from page_browser import (
    NAME,
    Served,
    Watched,
    alike,
    at_rest,
    choose_folder,
    colors_of,
    hide_lines,
    new_picture,
    show_map,
)


def test_the_map_is_on_the_screen_and_turns_by_keys(watched, job):
    canvas = show_map(watched, job)
    hide_lines(watched.page)
    first = at_rest(canvas)
    assert colors_of(first) > 1000
    canvas.focus()
    for _ in range(4):
        watched.page.keyboard.press("ArrowRight")
    new_picture(canvas, [first])
    watched.check()


def test_rough_poses_move_the_map_and_colors_change_by_choice(watched, job):
    canvas = show_map(watched, job)
    hide_lines(watched.page)
    pictures = [at_rest(canvas)]
    watched.page.get_by_role("button", name="Rough").click()
    pictures.append(new_picture(canvas, pictures))
    watched.page.get_by_role("button", name="Refined").click()
    for way in ("height", "views", "scan"):
        watched.page.get_by_label("Color by").select_option(way)
        pictures.append(new_picture(canvas, pictures))
    assert min(map(colors_of, pictures)) > 30
    watched.check()


def test_the_slider_goes_between_the_pictures_and_figures_are_shown(watched, job):
    show_map(watched, job)
    page = watched.page
    page.get_by_role("button", name="Compare photographs").click()
    slider = page.get_by_role("slider", name="Map before")
    pictures = page.locator(".slider img")
    page.wait_for_function(
        "() => [...document.querySelectorAll('.slider img')].every((one) => one.naturalWidth > 0)"
    )
    assert pictures.count() == 2
    slider.focus()
    shown = page.locator(".slider-left")
    first = shown.evaluate("(picture) => getComputedStyle(picture).clipPath")
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    assert shown.evaluate("(picture) => getComputedStyle(picture).clipPath") != first
    page.get_by_label("Left side").select_option("photo")
    page.get_by_role("slider", name="Photograph").wait_for()
    page.get_by_role("button", name="Next image").click()
    assert page.get_by_label("Image", exact=True).input_value() == "1"
    page.get_by_role("button", name="View from here").click()
    canvas = page.get_by_role("application", name="Map in 3D")
    from_there = at_rest(canvas)
    hide_lines(page)
    # frustums and paths do not lie across the view from a camera; on the left are the boxes that were unchecked
    assert alike(at_rest(canvas), from_there, right=0.5)
    assert page.get_by_role("img", name="PSNR").count() == 1
    assert page.get_by_role("img", name="Relative exposure").count() == 1
    watched.accessible()
    watched.check()


def test_photographs_are_compared_without_scrolling_on_a_small_laptop(watched, job):
    watched.page.set_viewport_size({"width": 1280, "height": 800})
    show_map(watched, job)
    button = watched.page.get_by_role("button", name="Compare photographs")
    assert button.bounding_box()["y"] < 200
    button.click()
    # the page scrolls after it has painted the photographs
    watched.page.wait_for_function(
        """() => {
            const box = document.querySelector(".compare")?.getBoundingClientRect();
            return box && box.top >= 0 && box.bottom <= innerHeight;
        }"""
    )


def test_on_a_phone_nothing_lies_beside_the_screen_and_letters_can_be_read(browser, served, job):
    phone = Watched(browser, served.url)
    page = phone.page
    page.set_viewport_size({"width": 390, "height": 844})
    phone.go("jobs")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name=NAME, exact=True))
    for shown in (row.get_by_role("link", name="Result of"), row.locator(".gain-cell")):
        box = shown.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
    phone.accessible()
    row.get_by_role("link", name="Result of").click()
    page.locator(".chart .tick").first.wait_for()
    # charts are drawn once more when the page knows how wide they are
    page.wait_for_function(
        """() => [...document.querySelectorAll(".chart .tick")].every(
            (one) => parseFloat(getComputedStyle(one).fontSize) * one.getScreenCTM().a >= 12)"""
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    phone.accessible()
    phone.check()
    phone.context.close()


def test_every_figure_of_a_step_is_explained_by_the_state_before_it(watched, job):
    show_map(watched, job)
    kept = watched.page.get_by_role("region", name="Acceptance of stages")
    kept.get_by_text("Each stage is compared with the state before it").wait_for()
    top = (
        watched.page.get_by_role("list", name="The input and the result").get_by_text("dB").all_inner_texts()
    )
    rows = kept.get_by_role("row").all_inner_texts()
    first, last = (next(row for row in rows if word in row) for word in ("The input", "the result"))
    assert [row.split()[-2] for row in (first, last)] == [text.split()[0] for text in top]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_result_is_accessible_in_light_and_dark(browser, served, job, scheme):
    watched = Watched(browser, served.url, color_scheme=scheme)
    show_map(watched, job)
    watched.accessible()
    watched.go("jobs")
    watched.page.get_by_role("link", name=NAME, exact=True).wait_for()
    watched.accessible()
    watched.check()
    watched.context.close()


def test_files_come_home_as_they_are_on_the_server(watched, served, job, tmp_path):
    show_map(watched, job)
    with watched.page.expect_download() as download:
        watched.page.get_by_role("link", name="map.ply").click()
    download.value.save_as(tmp_path / "map.ply")
    there = served.data / "jobs" / job / "out" / "map.ply"
    assert digest(tmp_path / "map.ply") == digest(there)
    with watched.page.expect_download() as download:
        watched.page.get_by_role("link", name="Download all").click()
    assert download.value.suggested_filename.endswith(".zip")
    watched.check()


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_an_upload_goes_on_after_lost_connections_and_a_reload(watched, recording, job):
    """A third of the pieces never arrive, then the page is closed: what is there is not sent again."""
    page, sent, tries = watched.page, [], {}
    # 404: the page asks how much of a lost file arrived, which is nothing
    watched.allowed = [r"net::ERR_", r"Failed to load resource", r"status 404: .*/files/"]

    def lose_some(route):
        if route.request.method != "PUT":
            return route.continue_()
        path = route.request.url.split("/files/")[1]
        tries[path] = tries.get(path, 0) + 1
        if tries[path] == 1 and len(tries) % 3 == 0:
            return route.abort()
        if len(sent) >= stop_after:
            return None  # hangs, as long as the page is open
        sent.append(path)
        return route.continue_()

    stop_after = 10
    page.route("**/v1/datasets/*/files/**", lose_some)
    watched.go("new")
    page.get_by_text("Upload another").click()
    choose_folder(page, recording)
    page.get_by_label("Name", exact=True).fill("cut off")
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_text("10 of").wait_for()
    page.on("dialog", lambda dialog: dialog.accept())
    first, stop_after = list(sent), 10_000
    sent.clear()
    page.reload()
    page.get_by_role("list", name="Unfinished uploads").get_by_role("button", name="continue").click()
    choose_folder(page, recording)
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("radio", name="cut off").wait_for()
    assert set(first).isdisjoint(sent)
    files = [path for path in recording.rglob("*") if path.is_file()]
    assert len({*first, *sent}) == len(files)
    watched.check()


def test_what_the_server_refuses_is_told_beside_the_setting(watched, job):
    watched.allowed = ["422"]
    page = watched.page
    watched.go("new")
    page.get_by_role("radio", name=NAME).check()
    page.get_by_role("searchbox", name="Search settings").fill("pyramid levels")
    page.get_by_label("visual levels", exact=True).fill("77")
    page.get_by_label("visual levels", exact=True).blur()
    page.get_by_role("button", name="Start").click()
    page.locator(".trouble").filter(has_text="visual.levels").wait_for()
    assert page.get_by_text("must be 1 to 6").count() == 1
    assert (
        page.locator(".option", has=page.get_by_label("visual levels", exact=True))
        .get_by_role("alert")
        .inner_text()
        .startswith("levels is 77")
    )
    watched.check()


def test_a_restart_of_the_service_is_survived_by_the_page(watched, served, job):
    """The live connection breaks and comes back by itself; what happens after it is shown."""
    # who asks while the service ends hears so, and asks again
    watched.allowed = [r"net::ERR_", "Failed to load resource", "status 503"]
    page = watched.page
    watched.go("jobs")
    page.get_by_role("link", name=NAME, exact=True).wait_for()
    served.stop()
    served.start()
    with served.gates.held("lidar"):
        page.evaluate(
            """async (job) => {
                const { dataset } = await (await fetch(`/v1/jobs/${job}`)).json();
                const body = JSON.stringify({ dataset, name: "after the restart" });
                const headers = { "Content-Type": "application/json" };
                await fetch("/v1/jobs", { method: "POST", body, headers });
            }""",
            job,
        )
        page.get_by_role("link", name="after the restart", exact=True).click()
        page.locator(
            ".step-running"
        ).first.wait_for()  # a job canceled before that has no stage that could be stopped
        page.get_by_role("button", name="Cancel").click()
        page.get_by_text("canceled").first.wait_for()
        page.locator(".step-stopped").first.wait_for()
        assert page.locator(".step-failed").count() == 0
    page.get_by_role("button", name="Delete").first.click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    page.get_by_role("heading", name="Jobs").wait_for()
    watched.check()


def test_a_key_is_asked_for_and_opens_maps_and_files(browser, served, job, tmp_path_factory):
    served.stop()
    locked = Served(served.data, "--auth")
    try:
        key = locked.key("local")
        watched = Watched(browser, locked.url)
        watched.allowed = ["401"]
        page = watched.page
        watched.go(f"jobs/{job}/result")
        watched.accessible()
        asked, late = [], []

        def hold(route):
            """Answers to all but the first question with the wrong key come when the right one is used."""
            wrong = "lvba_0_wrong" in route.request.headers.get("authorization", "")
            if wrong and asked:
                late.append(route)
                return
            asked.extend([route] * wrong)
            route.continue_()

        page.route("**/v1/me", hold)
        page.get_by_label("API key").fill("lvba_0_wrong")
        page.get_by_role("button", name="Sign in").click()
        page.locator(".field-problem").filter(has_text="key").wait_for()
        # these words are there before, too, when a key was typed
        page.wait_for_function("() => sessionStorage.getItem('lvba-key') === null")
        page.get_by_label("API key").fill(key)
        page.get_by_role("button", name="Sign in").click()
        page.locator("form.signin").wait_for(state="detached")
        assert asked
        assert late
        for route in late:
            route.continue_()
        page.unroute("**/v1/me")
        page.wait_for_function(
            "() => /^[1-9]/.test(document.querySelector('.cloud-status')?.textContent ?? '')"
        )
        page.get_by_role("button", name="Compare photographs").click()
        page.wait_for_function(
            "() => [...document.querySelectorAll('.slider img')].some((one) => one.naturalWidth > 0)"
        )
        with page.expect_download() as download:
            page.get_by_role("link", name="exposures.csv").click()
        assert download.value.path().read_text().startswith("timestamp")
        page.reload()
        page.get_by_role("link", name="exposures.csv").wait_for()
        assert page.evaluate("localStorage.getItem('lvba-key')") is None
        page.get_by_role("button", name="Sign out").click()
        page.reload()
        page.get_by_label("Keep me signed in on this computer").check()
        page.get_by_label("API key").fill(key)
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("link", name="exposures.csv").wait_for()
        another = watched.context.new_page()
        another.goto(page.url)
        another.get_by_role("link", name="exposures.csv").wait_for()
        another.get_by_role("button", name="Sign out").click()
        another.reload()
        another.get_by_label("API key").wait_for()
        watched.check()
        watched.context.close()
    finally:
        locked.stop()
        served.start()


def test_a_restart_with_another_setting_shows_what_was_reused(watched, served, job):
    page = watched.page
    watched.go(f"jobs/{job}")
    page.get_by_role("button", name="Restart…").click()
    dialog = page.get_by_role("dialog", name="Restart")
    dialog.get_by_text("Settings", exact=True).click()
    assert dialog.get_by_label("visual levels", exact=True).input_value() == "2"  # the job's own
    dialog.get_by_role("searchbox", name="Search settings").fill("map colors")
    dialog.get_by_label("map colors", exact=True).select_option(label="paper")
    watched.accessible()
    with served.gates.held("map"):
        dialog.get_by_role("button", name="Restart").click()
        page.get_by_role("link", name="See the result").wait_for(state="detached")
    page.get_by_role("link", name="See the result").wait_for()
    lidar = page.locator(".step").filter(has=page.get_by_text("lidar", exact=True))
    assert lidar.get_by_text("reused").count() == 1
    of_map = page.locator(".step").filter(has=page.get_by_text("map", exact=True))
    assert of_map.get_by_text("reused").count() == 0
    page.get_by_text("Changed settings").click()
    page.get_by_text('"paper"').wait_for()
    watched.check()


def test_without_webgl_the_rest_of_the_result_is_there(browser, served, job):
    watched = Watched(browser, served.url)
    watched.page.add_init_script(
        "const old = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return kind === 'webgl2' ? null : old.call(this, kind, ...more); }"
    )
    watched.go(f"jobs/{job}/result")
    watched.page.get_by_text("has no WebGL 2").wait_for()
    watched.page.get_by_role("link", name="map.ply").wait_for()
    watched.check()
    watched.context.close()

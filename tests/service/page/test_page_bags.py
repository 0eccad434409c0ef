"""A bag in the page: what is in it is shown before it is sent, its import is a form, and its map opens."""

from page_browser import at_rest, colors_of, hide_lines, show_map


def test_a_bag_is_looked_into_uploaded_chosen_from_and_run_to_a_map(watched, served, bags, tmp_path):
    page, sent = watched.page, []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PUT" else None)
    watched.go("new")
    upload = page.locator("summary").filter(has_text="Upload")
    upload.wait_for()
    if upload.inner_text() == "Upload another":  # where the server has recordings of other tests
        upload.click()
    damaged = tmp_path / "damaged.bag"
    damaged.write_bytes(b"no bag")
    page.get_by_label("Choose bag").set_input_files(damaged)
    page.get_by_role("alert").get_by_text("damaged.bag: is no ROS 1 bag").wait_for()
    assert page.get_by_role("button", name="Upload", exact=True).is_disabled()

    camera = tmp_path / "camera.yaml"
    camera.write_text("cam0: {}\n")
    page.get_by_label("Choose bag").set_input_files([bags / "walk.bag", camera])
    inspection = page.get_by_role("region", name="What is in the bag")
    row = inspection.get_by_role("row").filter(has_text="/lidar/points")
    row.get_by_text("stamp: end of the sweep").wait_for()
    inspection.get_by_text("ROS 1 bag").wait_for()
    assert sent == []
    watched.accessible()
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("radio", name="walk").wait_for()
    assert page.get_by_role("radio", name="walk").is_checked()

    choices = page.get_by_role("region", name="2. Import")
    choices.get_by_label("lidar", exact=True).wait_for()
    assert choices.get_by_label("lidar", exact=True).locator("option").all_inner_texts() == [
        "(default)",
        "/lidar/points",
    ]
    choices.get_by_label("imu", exact=True).select_option(label="none")
    assert choices.get_by_label("camera.yaml").is_visible()
    choices.get_by_label("odometry", exact=True).select_option(label="camera.yaml")
    watched.accessible()
    page.get_by_role("button", name="Start").click()
    page.get_by_role("alert").get_by_text("camera.yaml").first.wait_for()
    page.go_back()
    page.get_by_role("radio", name="walk").check()
    choices.get_by_label("imu", exact=True).select_option(label="none")
    page.get_by_role("button", name="Start").click()
    page.get_by_role("link", name="See the result").wait_for()
    page.get_by_text("Choices of the import").click()
    page.get_by_text('"imu": "none"').wait_for()
    page.get_by_role("listitem").filter(has_text="import").first.wait_for()
    job = page.url.rsplit("/", 1)[-1]
    canvas = show_map(watched, job)
    hide_lines(page)
    assert colors_of(at_rest(canvas)) > 300
    watched.check()

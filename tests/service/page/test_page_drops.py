"""Folders that are dropped onto the page, as the browser hands them over: a bag of ROS 2, and a recording."""

import shutil

import pytest


@pytest.fixture
def page(watched):
    """The page of a new job, where recordings are dropped."""
    watched.go("new")
    upload = watched.page.locator("summary").filter(has_text="Upload")
    upload.wait_for()
    if upload.inner_text() == "Upload another":  # where the server has recordings of other tests
        upload.click()
    return watched.page


def drop(page, *paths):
    """What a person does with folders or files of a file manager; no script of the page can."""
    target = page.get_by_text("Drop a recording here")
    target.scroll_into_view_if_needed()
    box = target.bounding_box()
    place = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    protocol = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        protocol.send("Input.dispatchDragEvent", {"type": kind, **place, "data": data})
    protocol.detach()


def sent_by(page):
    """Addresses that files are sent to from now on."""
    sent = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PUT" else None)
    return sent


def test_a_dropped_mcap_is_looked_into_uploaded_and_its_topics_are_choices(watched, page, bags):
    sent = sent_by(page)
    drop(page, bags / "walk_mcap")
    inspection = page.get_by_role("region", name="What is in the bag")
    inspection.get_by_text("MCAP file").wait_for()
    inspection.get_by_role("row").filter(has_text="/lidar/points").wait_for()
    assert sent == []
    watched.accessible()
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("radio", name="walk_mcap").wait_for()
    assert page.get_by_role("radio", name="walk_mcap").is_checked()
    assert any(url.endswith(".mcap") for url in sent)
    choices = page.get_by_role("region", name="2. Import")
    # the form is built when the inspection of the upload has come
    options = choices.get_by_label("lidar", exact=True).locator("option")
    options.first.wait_for(state="attached")
    assert "/lidar/points" in options.all_inner_texts()
    assert page.get_by_role("button", name="Start").is_enabled()
    watched.check()


def test_a_dropped_folder_is_checked_before_it_is_sent(watched, page, recording, tmp_path):
    sent = sent_by(page)
    broken = shutil.copytree(recording, tmp_path / "dropped yard")
    (broken / "all_pcd_body").rename(broken / "scans")
    drop(page, broken)
    page.get_by_role("button", name="Upload", exact=True).click()
    refusal = page.get_by_role("alert").get_by_text("DATASET/all_pcd_body: there is no such folder")
    refusal.wait_for()
    assert sent == []
    (broken / "scans").rename(broken / "all_pcd_body")
    drop(page, broken)
    refusal.wait_for(state="hidden")
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("radio", name="dropped yard").wait_for()
    scans = {path.name for path in broken.glob("all_pcd_body/*.pcd")}
    assert scans <= {url.rsplit("/", 1)[-1] for url in sent}
    watched.check()

"""Recordings in the page: wrong ones are told before anything is sent, mended with what is wrong alone, and deleted."""

import shutil

import pytest
from page_browser import choose_folder


@pytest.fixture
def broken(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "broken yard")


def upload(page, folder):
    page.get_by_text("Upload another").click()
    choose_folder(page, folder)
    page.get_by_role("button", name="Upload", exact=True).click()


def test_a_wrong_folder_is_told_with_the_mend_before_anything_is_sent(watched, job, broken):
    (broken / "all_pcd_body").rename(broken / "scans")
    page, sent = watched.page, []
    page.on("request", lambda request: sent.append((request.method, request.url)))
    watched.go("new")
    upload(page, broken)
    trouble = page.get_by_role("alert")
    trouble.get_by_text("DATASET/all_pcd_body: there is no such folder").wait_for()
    trouble.get_by_text("put <seconds>.pcd and lidar_poses.txt there").wait_for()
    assert [
        url for method, url in sent if method == "PUT" or (url.endswith("/v1/datasets") and method == "POST")
    ] == []
    watched.accessible()
    watched.check()


def test_an_invalid_recording_is_mended_by_the_wrong_file_alone_and_deleted(watched, served, job, broken):
    scans = sorted((broken / "all_pcd_body").glob("*.pcd"))
    config, good = broken / "config.yaml", (broken / "config.yaml").read_text()
    wrong = good.replace("cam_fx", "cam_fy_", 1)[: len(good)]
    config.write_text(wrong + "#" * (len(good) - len(wrong)))
    page, sent = watched.page, []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PUT" else None)
    # as if the check before the upload had found nothing
    page.route("**/v1/checks?*", lambda route: route.fulfill(json={"error": None}))
    watched.go("new")
    upload(page, broken)
    page.get_by_text("is missing or wrong").wait_for()
    assert len(sent) > len(scans)
    sent.clear()
    config.write_text(good)
    page.get_by_label("Choose files").set_input_files(config)
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("radio", name="broken yard").wait_for()
    assert [url.rsplit("/", 1)[-1] for url in sent] == ["config.yaml"]
    watched.accessible()
    page.get_by_role("button", name="delete broken yard").click()
    dialog = page.get_by_role("dialog", name="Delete broken yard?")
    dialog.get_by_text("on the server's disk become free").wait_for()
    dialog.get_by_role("button", name="Delete").click()
    page.get_by_role("radio", name="broken yard").wait_for(state="detached")
    watched.check()


def test_a_failed_upload_is_deleted_with_what_it_takes(watched, job, broken):
    (broken / "all_pcd_body" / "lidar_poses.txt").unlink(missing_ok=True)
    (broken / "lidar_poses.txt").unlink(missing_ok=True)
    page = watched.page
    page.route("**/v1/checks?*", lambda route: route.fulfill(json={"error": None}))
    watched.go("new")
    upload(page, broken)
    unfinished = page.get_by_role("list", name="Unfinished uploads")
    unfinished.get_by_text("no poses: there is no such file").wait_for()
    unfinished.get_by_role("button", name="delete broken yard").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    unfinished.get_by_text("broken yard", exact=True).wait_for(state="detached")
    watched.check()

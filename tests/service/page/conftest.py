"""One service with one small job for all tests of the page, and a browser.

They end with these tests: the browser's driver keeps an event loop running in this thread, in which no other can be.
"""

import pytest
from browsers import browser_or_skip
from page_browser import NAME, Served, Watched, choose_folder

from lvba import simulate


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings") / NAME
    simulate.simulate(
        "courtyard", folder, frames=8, scans=8, seed=3, width=160, height=120, points_per_scan=6000
    )
    return folder


@pytest.fixture(scope="package")
def browser():
    yield from browser_or_skip()


@pytest.fixture(scope="package")
def served(tmp_path_factory, browser):
    served = Served(tmp_path_factory.mktemp("served") / "data", forked=False)
    yield served
    served.stop()


@pytest.fixture
def watched(browser, served):
    watched = Watched(browser, served.url)
    yield watched
    watched.context.close()


@pytest.fixture(scope="package")
def job(browser, served, recording):
    """Id of a job that went through the page from the upload to its end."""
    watched = Watched(browser, served.url)
    page = watched.page
    watched.go("jobs")
    page.get_by_text("No jobs yet").wait_for()
    watched.accessible()
    page.get_by_role("link", name="New job").first.click()
    choose_folder(page, recording)
    held = []
    page.route("**/finish", lambda route: held.append(route))
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("progressbar", name="Upload").wait_for()
    page.unroute("**/finish")
    for route in held:
        route.continue_()
    page.get_by_role("radio", name=NAME).wait_for()
    assert page.get_by_role("radio", name=NAME).is_checked()
    page.get_by_role("searchbox", name="Search settings").fill("pyramid levels")
    page.get_by_label("visual levels", exact=True).fill("2")
    page.get_by_label("visual levels", exact=True).blur()
    page.get_by_text("1 changed").wait_for()
    watched.accessible()
    with served.gates.held("visual"):
        page.get_by_role("button", name="Start").click()
        page.get_by_role("progressbar", name="Progress of the job").wait_for()
        page.locator(".timeline .step").first.wait_for()
        watched.accessible()
    page.get_by_role("link", name="See the result").wait_for()
    assert page.locator(".timeline .step").count() == page.locator(".timeline .step-done").count()
    page.get_by_role("log").get_by_text("report:").wait_for()
    page.get_by_text("Changed settings").click()
    page.get_by_text('"levels": 2').wait_for()
    watched.accessible()
    job = page.url.rsplit("/", 1)[-1]
    watched.check()
    watched.context.close()
    return job

"""The page in a real browser: its token and its policy let it work, and nothing of a stranger's is run in it."""

import time

import pytest
from support.browser import opened, press, unfold, wait_until
from support.served_page import served

pytestmark = pytest.mark.slow

NAME = '<iframe srcdoc="<script>parent.document.title=1</script>"></iframe>'
PHOTOGRAPH = "//img[@class='nerf-photograph']"
# What markup of a stranger would do, had it got in all the same.
GOT_IN = """
const frame = document.createElement("div");
frame.innerHTML = `<iframe srcdoc="<script>parent.document.title=2</script>"></iframe>
    <img src=x onerror="document.title=3">`;
document.body.append(frame);
const script = document.createElement("script");
script.textContent = "document.title=4";
document.body.append(script);
"""
CALLS_OUT = """
const done = arguments[0];
const socket = new WebSocket("ws://127.0.0.1:1/");
socket.onerror = () => 0;
fetch("http://127.0.0.1:1/").catch(() => 0).finally(() => setTimeout(() => done(document.cookie), 100));
"""


def wait(true, seconds=40.0):
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return found


@pytest.fixture
def page(tmp_path):
    with served(tmp_path, record={"view_names": (NAME, "www.evil.example", "c", "d")}) as page:
        yield page


def complaints_of(browser):
    return [entry["message"] for entry in browser.get_log("browser") if "Content Security Policy" in entry["message"]]


def test_the_page_works_behind_its_policy_and_a_strangers_name_is_text(page):
    with opened(page.address) as browser:
        wait_until(browser, lambda picture: picture.std() > 5)
        assert complaints_of(browser) == []
        title = browser.title
        unfold(browser, "Photographs", PHOTOGRAPH)
        press(browser, "xpath", f"({PHOTOGRAPH})[1]")
        wait(lambda: NAME in browser.find_element("css selector", "body").text)
        assert browser.find_elements("css selector", "iframe") == []
        assert browser.title == title
        assert complaints_of(browser) == []
        # The cookie alone is enough from now on, and no script sees it.
        browser.get(page.address.partition("?")[0])
        wait_until(browser, lambda picture: picture.std() > 5)
        assert browser.execute_script("return document.cookie") == ""
        browser.execute_script(GOT_IN)
        browser.execute_async_script(CALLS_OUT)
        assert browser.title == title
        assert len(complaints_of(browser)) >= 4

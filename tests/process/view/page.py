#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
#
# Checks the page of dssm-view in a browser: Debian's Chromium without a window, driven by selenium.
#
#   page.py CHECK URL FOLDER [ARGUMENT...]
#
# CHECK is the name of a function below, which says what its arguments are. Screenshots are written
# to FOLDER. Prints lines for the test that runs it, and "ok" at the end; otherwise what went wrong,
# with exit status 1. In no check may the page report an error in the browser's console.
import glob
import json
import os
import sys
import tempfile
import time
import urllib.parse

os.environ["SE_OFFLINE"] = "true"  # selenium must not download a driver

from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

BROWSER = "/usr/bin/chromium"
DRIVER = "/usr/bin/chromedriver"
TIMEOUT_S = 120  # only a page that hangs takes that long
POLL_S = 0.02
DESKTOP = (1280, 900)
PHONE = (360, 740)


class Page:
    def __init__(self, url, folder, profile):
        self.url, self.folder = url, folder
        self.may_report = []  # parts of messages in the console that belong to the check
        options = Options()
        options.binary_location = BROWSER
        for argument in [
            "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
            "--no-first-run", "--hide-scrollbars", "--user-data-dir=" + profile,
        ]:
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(service=Service(DRIVER), options=options)
        self.driver.set_page_load_timeout(TIMEOUT_S)
        self.driver.set_script_timeout(TIMEOUT_S)
        self.show_as(DESKTOP, "light")

    def show_as(self, size, scheme):
        width, height = size
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == PHONE})
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {
            "features": [{"name": "prefers-color-scheme", "value": scheme}]})

    def open(self, tab, **state):
        """Loads the page with `tab`; `state`: "signals" and "views" of the fragment."""
        fragment = {"tab": tab} | {key: json.dumps(value) for key, value in state.items()}
        self.driver.get("about:blank")  # otherwise only the fragment would change
        self.driver.get(self.url + "#" + urllib.parse.urlencode(fragment))
        self.await_connected()

    def await_connected(self):
        self.wait("connected", lambda: self.get("#connection", "data-state") == "connected")

    def all(self, selector):
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def one(self, selector):
        found = self.all(selector)
        assert len(found) == 1, f"there are {len(found)} elements '{selector}'"
        return found[0]

    def get(self, selector, attribute):
        return self.one(selector).get_attribute(attribute)

    def choose(self, selector, words):
        """The option that begins so. Not by keys: on a busy PC, they come too slowly to be one word."""
        choice = Select(self.one(selector))
        index = next(i for i, option in enumerate(choice.options) if option.text.startswith(words))
        choice.select_by_index(index)

    def run(self, script, *arguments):
        return self.driver.execute_script(script, *arguments)

    def press(self, *keys):
        ActionChains(self.driver).send_keys(*keys).perform()

    def wait(self, what, condition):
        """Until `condition` gives something, which it returns."""
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            try:
                result = condition()
            except (AssertionError, StaleElementReferenceException):  # elements still change
                result = None
            if result:
                return result
            time.sleep(POLL_S)
        self.shot("failed")
        text = self.one("body").text.replace("\n", "\n  ")  # no line is the "ok" of the end
        raise AssertionError(f"not so within {TIMEOUT_S} s: {what}\n  {text}")

    def shot(self, name):
        assert self.driver.save_screenshot(os.path.join(self.folder, name + ".png"))

    def close(self):
        try:
            return [entry["message"] for entry in self.driver.get_log("browser")
                    if not any(part in entry["message"] for part in self.may_report)]
        finally:
            self.driver.quit()


def say(*words):
    print(*words, flush=True)


def stream_row(stream):
    return f"#streams tr[data-stream='{stream}']"


def card(stream):
    return f"#cards .card[data-stream='{stream}']"


# --- checks ---------------------------------------------------------------------------------------


def overview(page, program, *streams):
    """Hosts and `streams` are shown; `program`, which writes to one of them, as text."""
    page.open("overview")
    for host in ["pc1", "pc2", "pc3"]:
        row = f"#hosts tr[data-host='{host}']"
        page.wait(host, lambda: page.get(row, "data-state") in ["self", "up"])
        page.wait(f"{host}'s clock", lambda: page.get(f"{row} .bar", "data-level") == "ok")
    for stream in streams:
        page.wait(stream, lambda: page.one(stream_row(stream)))
    page.wait("the writer", lambda: program in page.one("#streams").text)
    page.wait("the writer's box", lambda: page.all("#graph .program"))
    boxes = [box.get_attribute("textContent") for box in page.all("#graph title")]
    assert any(program in box for box in boxes), boxes
    assert not page.all("#overview img"), "a name was taken for markup"
    assert page.all("#graph path.edge"), "the graph has no arrow"
    assert page.one("#findings-group").text.count("\n") > 0, "no findings of doctor"
    page.shot("overview-light")
    for what in ["first-contentful-paint", "first view"]:
        times = page.run("return performance.getEntriesByName(arguments[0])", what)
        say(what, *(f"{entry['startTime']:.0f} ms after the request" for entry in times))
    loaded = page.run("return performance.getEntriesByType('navigation')[0].responseEnd")
    say(f"the page's text {loaded:.0f} ms after it")
    page.show_as(DESKTOP, "dark")
    page.wait("dark", lambda: page.run("return document.documentElement.dataset.theme") == "dark")
    page.shot("overview-dark")


def signal(page, stream, field):
    """The curve of a field follows its stream, and stands still while held."""
    page.open("signals", signals={"span": 10, "panels": [[[stream, field]]]})
    legend = f"[data-signal='{stream} {field}']"

    def shown():
        return int(page.get(legend, "data-tid") or -1)

    def newest():
        text = page.run("return arguments[0].cells[4].textContent", page.one(stream_row(stream)))
        return int(text) if text.isdigit() else -1

    first = page.wait("a value", lambda: shown() > 0 and shown())
    page.wait("the value follows", lambda: shown() > first + 20)
    page.wait("a curve", lambda: int(page.get(".panel", "data-points") or 0) > 20)
    page.press(" ")
    page.wait("held", lambda: page.get("#time", "data-mode") == "hold")
    t = page.wait("the held instant", lambda: page.get("#time", "data-t-ns"))
    # Both at once: the last answer from before may come in between.
    both = """return [document.querySelector("#shown-t").dataset.tNs,
                      document.querySelector(arguments[0]).dataset.tid]"""

    def held_tid():
        shown_t, tid = page.run(both, legend)
        return int(tid or -1) if shown_t == t else None

    held = page.wait("settled", held_tid)
    before = newest()
    page.wait("the stream goes on", lambda: newest() > max(before, held) + 20)
    assert shown() == held, f"held {held}, but {shown()} is shown"
    page.shot("signals-light")
    picture = "return document.querySelector('.panel canvas').toDataURL()"
    still = page.run(picture)
    page.press("l")
    page.wait("live again", lambda: shown() > held + 20)
    page.wait("the curve moves", lambda: page.run(picture) != still)
    for button in ["#tab-signals", "#live"]:
        page.one(button).click()
        for mode in ["hold", "live"]:
            page.press(" ")
            page.wait(f"{mode} by Space after a click on {button}",
                      lambda: page.get("#time", "data-mode") == mode)
    check_pressed(page, "light")
    # The cursor stays at the pointer while the curve moves, and a click holds the time that it has.
    plot = page.one(".u-over")
    ActionChains(page.driver).move_to_element(plot).perform()
    pointer = plot.rect["x"] + int(plot.rect["width"] / 2)
    place = ("return [document.querySelector('.cursor-line').getBoundingClientRect().left,"
             " document.querySelector('#shown-t').dataset.tNs]")
    first = page.wait("the cursor", lambda: page.one(".cursor-line").is_displayed()
                      and page.run(place)[1])
    left, last = page.wait("later values", lambda: int(page.run(place)[1]) > int(first) + 10**9
                           and page.run(place))
    assert abs(left - pointer) < 3, f"the cursor is at {left}, the pointer at {pointer}"
    ActionChains(page.driver).click().perform()
    page.wait("held", lambda: page.get("#time", "data-mode") == "hold")
    held = page.get("#time", "data-t-ns")
    assert int(held) >= int(last), f"a click holds {held}, but {last} was shown"
    page.wait("it is shown", lambda: page.run(place)[1] == held)
    assert abs(page.run(place)[0] - pointer) < 3
    page.press("l")
    page.show_as(DESKTOP, "dark")
    page.wait("dark", lambda: page.run("return document.documentElement.dataset.theme") == "dark")
    page.shot("signals-dark")
    check_pressed(page, "dark")
    page.open("signals")
    page.wait("suggested panels", lambda: page.all(".legend"))
    names = [item.get_attribute("data-signal") for item in page.all(".legend li")]
    assert names[0].startswith(stream), f"{names} are suggested before the live stream"


def check_pressed(page, scheme):
    """The pressed button of the time keeps its colours below the pointer."""
    colours = """const {color, backgroundColor} = getComputedStyle(arguments[0]);
                 return [color, backgroundColor]"""
    live = page.one("#live")
    ActionChains(page.driver).move_to_element(page.one("#host")).perform()
    before = page.run(colours, live)
    ActionChains(page.driver).move_to_element(live).perform()
    assert page.run(colours, live) == before, f"the pressed button changes when {scheme}"


def axes(page, stream, *fields):
    """Plots have the same edges: of values as large and small as these, and without samples."""
    page.open("signals", signals={"panels": [[[stream, field]] for field in fields]
                                     + [[[stream, "none"], [stream, "some"]]]})
    page.wait("curves", lambda: sum(
        int(panel.get_attribute("data-points") or 0) > 1 for panel in page.all(".panel")
    ) == len(fields))

    def edges():
        return {(plot.rect["x"], plot.rect["width"]) for plot in page.all(".u-over")}

    page.wait("that there is no such field", lambda: "no such field" in page.one(
        f"[data-signal='{stream} none']").text)
    page.wait("room for the labels of large values", lambda: min(edges())[0] > 90)
    page.wait("the same edges", lambda: len(edges()) == 1)
    page.shot("axes")


def recreated(page, stream, field):
    """The view of a stream that is created again, with another type, gets the fields of that."""
    page.open("views", views=[{"stream": stream}])
    page.wait("a sample", lambda: page.get(card(stream), "data-tid"))
    say("shown")
    page.wait("the field", lambda: field in page.one(card(stream)).text)


def slider(page, *streams):
    """Prints for places of the slider the shown time [ns], and the shown tid of each stream."""
    page.open("views", views=[{"stream": stream} for stream in streams])

    def tids():
        return [page.get(card(stream), "data-tid") for stream in streams]

    page.wait("samples", lambda: all(tids()))
    page.wait("what the rings hold", lambda: page.get("#time", "data-oldest-ns"))
    for part in [0.3, 0.55, 0.8, 0.9]:
        place, held = page.run(
            "const slider = document.getElementById('slider');"
            "const {dataset} = document.getElementById('time');"
            "const place = slider.value = Math.round(arguments[0] * Number(slider.max));"
            "slider.dispatchEvent(new Event('input'));"
            "return [place, Number(BigInt(dataset.tNs) - BigInt(dataset.oldestNs))]", part)
        assert place == held, f"the slider is at {place} ns, the held instant at {held} ns"
        page.wait("held", lambda: page.get("#time", "data-mode") == "hold")
        say("at", settled(page, streams), *tids())
    before = tids()
    page.press(Keys.ARROW_LEFT)
    page.wait("a step back", lambda: int(tids()[0]) == int(before[0]) - 1)
    say("at", settled(page, streams), *tids())
    page.press(Keys.ARROW_RIGHT)
    page.wait("a step on", lambda: tids()[0] == before[0])
    say("at", settled(page, streams), *tids())


def oldest(page, stream, oldest_ns, second_ns):
    """Home shows the oldest sample of `stream`, and steps lead on from there."""
    page.open("views", views=[{"stream": stream}])
    page.wait("a sample", lambda: page.get(card(stream), "data-tid"))
    page.wait("what the rings hold", lambda: page.get("#time", "data-oldest-ns") == oldest_ns)
    for key, t, tid in [(Keys.HOME, oldest_ns, "0"), (Keys.ARROW_RIGHT, second_ns, "1"),
                        (Keys.ARROW_LEFT, oldest_ns, "0")]:
        page.press(key)
        page.wait(f"tid {tid}", lambda: page.get(card(stream), "data-tid") == tid)
        assert settled(page, [stream]) == t


def oldest_live(page, stream):
    """Of a ring that loses its oldest samples meanwhile, Home and Play begin where some are left,
    and Play goes on where some are left."""
    page.open("views", views=[{"stream": stream}])
    page.wait("the ring is full", lambda: int(page.get(card(stream), "data-tid") or 0) > 400)
    first = int(page.get("#time", "data-oldest-ns"))
    page.wait("the ring goes on", lambda: int(page.get("#time", "data-oldest-ns")) > first)

    def begins():
        """Home; false where a busy PC shows that instant only when the ring has lost it, too."""
        page.press(Keys.HOME)
        end = time.monotonic() + 3
        while time.monotonic() < end:
            is_shown = page.get("#time", "data-t-ns") == page.get("#shown-t", "data-t-ns")
            if is_shown and page.get(card(stream), "data-status") == "ok":
                return page.get("#time", "data-mode") == "hold"
            time.sleep(0.02)
        return False
    page.wait("Home shows a sample", begins)
    page.press("l")
    page.wait("live", lambda: page.get("#time", "data-mode") == "live")
    page.press("r")
    page.wait("it plays", lambda: page.get("#time", "data-mode") == "play")
    first = page.wait("a sample", lambda: page.get(card(stream), "data-tid"))
    page.wait("later ones", lambda: int(page.get(card(stream), "data-tid") or 0) > int(first) + 20)
    page.choose("#rate", "0.1")
    page.wait("samples that were not there at first",
              lambda: int(page.get(card(stream), "data-tid") or 0) > int(first) + 400)
    assert page.get("#time", "data-mode") == "play"


def absent(page, early, late, image):
    """At an instant where a stream has no sample, its view is empty and says why."""
    page.may_report = ["willReadFrequently"]  # this check reads pixels
    page.open("views", views=[{"stream": early}, {"stream": late}, {"stream": image},
                              {"stream": "nothing:0@pc1"}])
    pixel = "return [...arguments[0].getContext('2d').getImageData(40, 30, 1, 1).data]"

    def shown(stream):
        """Whether the drawing is seen; what is seen instead of it."""
        text = page.one(f"{card(stream)} .absence").text
        return page.one(f"{card(stream)} .drawing").is_displayed(), text

    def pixel_of(stream):
        return page.run(pixel, page.one(card(stream) + " canvas"))

    def await_all():
        for stream in [early, late, image]:
            page.wait(f"{stream} is shown", lambda: page.get(card(stream), "data-tid")
                      and shown(stream) == (True, ""))
        page.wait("the image", lambda: pixel_of(image) == [70, 70, 70, 255])

    await_all()
    page.wait("what is wrong", lambda: "nothing" in shown("nothing:0@pc1")[1])
    page.press(Keys.HOME)
    settled(page, [early])
    for stream in [late, image]:
        page.wait(f"no sample of {stream}",
                  lambda: shown(stream) == (False, "the ring begins 500 ms later"))
        assert page.one(card(stream)).text.count("500 ms later") == 1
    assert shown(early) == (True, "")
    assert pixel_of(image) == [0, 0, 0, 0], "the canvas still has the image of another instant"
    page.shot("absent")
    page.press("l")
    await_all()


def described_later(page, stream, later, field):
    """The views of streams without fields get them while they are open: those of `stream` when the
    program that writes to it is there, and they remain without it; of `later`, when they are
    described."""
    page.open("views", views=[{"stream": stream}, {"stream": later}])
    for name in [stream, later]:
        page.wait("bytes", lambda: page.get(card(name), "data-kind") == "hex")
    say("hex")
    page.wait("the field", lambda: field in page.one(card(stream)).text)
    assert page.get(card(later), "data-kind") == "hex"
    say("of the program")
    page.wait("the other field", lambda: "watts" in page.one(card(later)).text)
    page.open("overview")
    page.wait("the program's end", lambda: page.get(stream_row(stream), "data-state") in
              ["no writer", "stalled"] and "state_writer" not in page.one("#streams").text)
    page.open("views", views=[{"stream": stream}])
    page.wait("the field is there still", lambda: field in page.one(card(stream)).text)


def pictures(page, rgb, described, jpeg):
    """Images of colours are drawn: raw ones, those with their size in fields, and JPEGs."""
    page.may_report = ["willReadFrequently"]  # this check reads pixels
    page.open("views")
    pixel = ("const [c, x, y] = arguments;"
             "return [c.width, c.height, ...c.getContext('2d').getImageData(x, y, 1, 1).data]")

    def at(stream, x, y):
        return page.run(pixel, page.one(card(stream) + " canvas"), x, y)

    for stream in [rgb, described, jpeg]:
        page.wait(f"{stream} as an image", lambda: page.get(card(stream), "data-kind") == "image")
    for x, y in [(40, 30), (159, 119)]:
        page.wait("RGB", lambda: at(rgb, x, y) == [160, 120, x, y, 200, 255])
    page.wait("its note", lambda: "160 \u00d7 120, RGB" in page.one(card(rgb)).text)
    for x, y in [(3, 2), (19, 9)]:
        page.wait("RGB with fields", lambda: at(described, x, y) == [20, 10, x, y, 100, 255])
    colour = page.wait("the JPEG", lambda: at(jpeg, 16, 8)[:2] == [32, 16] and at(jpeg, 16, 8)[2:])
    difference = [abs(a - b) for a, b in zip(colour, [207, 35, 51, 255])]
    assert max(difference) <= 4, f"the JPEG has the colour {colour}"
    page.wait("its note", lambda: "32 \u00d7 16, JPEG" in page.one(card(jpeg)).text)
    page.shot("pictures")


def settled(page, streams):
    """Waits until the views show the held instant; returns it."""
    def held():
        t = page.get("#time", "data-t-ns")
        ok = all(page.get(card(stream), "data-status") == "ok" for stream in streams)
        return ok and t == page.get("#shown-t", "data-t-ns") and t
    return page.wait("the views show the instant", held)


def link(page, stream, *fields):
    """What is chosen is in the URL: a reload shows the same."""
    panels = [[[stream, fields[0]], [stream, fields[1]]], [[stream, fields[2]]]]
    page.open("signals", signals={"span": 60, "panels": panels})

    def names():
        return [item.get_attribute("data-signal") for item in page.all(".legend li")]

    wanted = [f"{stream} {field}" for field in fields]
    page.wait("the chosen signals", lambda: names() == wanted and len(page.all(".panel")) == 2)
    assert page.get("#span", "value") == "60"
    page.one(f"[data-signal='{wanted[0]}'] button").click()
    page.wait("one was removed", lambda: names() == wanted[1:])
    removed = urllib.parse.quote(f'"{fields[0]}"')
    page.wait("it is not in the URL", lambda: removed not in page.driver.current_url)
    page.driver.refresh()
    page.await_connected()
    page.wait("the same after a reload", lambda: names() == wanted[1:])
    assert page.get("#span", "value") == "60"
    # A link that was cut off or changed shows what it can.
    page.open("signals", signals=[1, {"panels": 5}], views={"a": "b"})
    page.driver.get(page.url + "#tab=nothing&signals=%7B&views=%5B%7B%7D%2C5%5D&t=abc")
    page.wait("the overview", lambda: page.one("#overview").is_displayed())


def allow_downloads(page):
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {
        "behavior": "allow", "downloadPath": page.folder})


def export(page, stream, *fields):
    """Prints the paths of what is exported of `fields`: as CSV, and as a picture."""
    page.open("signals", signals={"span": 10, "panels": [[[stream, field] for field in fields]]})
    allow_downloads(page)
    page.wait("all samples", lambda: int(page.get(".panel", "data-points") or 0) >= 100)
    page.press(" ")
    page.wait("held", lambda: page.get("#time", "data-mode") == "hold")
    page.run("window.texts = []; const {prototype} = CanvasRenderingContext2D;"
             "const {fillText} = prototype; prototype.fillText = function (text, ...place)"
             " { window.texts.push(text); fillText.call(this, text, ...place); }")
    for ending in ["csv", "png"]:
        for old in glob.glob(os.path.join(page.folder, "dssm-signals-*." + ending)):
            os.remove(old)
        page.one("#export-" + ending).click()
        found = page.wait("the file", lambda: glob.glob(
            os.path.join(page.folder, "dssm-signals-*." + ending)))
        say(ending, *found)
    shown = page.one("#shown-t").text.split()[0]
    texts = page.run("return window.texts")
    assert any(text.endswith(" " + shown) for text in texts), f"no {shown} in the picture: {texts}"


def save(page, stream):
    """What the rings hold of `stream` is downloaded as a recording; prints its path."""
    page.open("views", views=[{"stream": stream, "kind": "property"}])
    page.wait("the property", lambda: page.one(card(stream) + " pre").text == "wheel_m = 0.1")
    allow_downloads(page)
    page.press("s")
    page.wait("the dialog", lambda: page.one("#save-dialog").is_displayed())
    page.choose("#save-range", "all that the rings hold")
    page.choose("#save-streams", "those shown")
    page.one("#save-now").click()
    page.wait("it is saved", lambda: "100 samples of 1 stream" in page.one("#save-result").text)
    name = page.one("#save-result a").text
    page.wait("it is here", lambda: os.path.exists(os.path.join(page.folder, name)))
    page.shot("save")
    say("saved", os.path.join(page.folder, name))


def views(page, scan, pose, image, raw):
    """Each type gets the view that fits, and it shows the sample."""
    page.may_report = ["willReadFrequently"]  # this check reads pixels
    page.open("views")
    for stream, kind in [(scan, "scan"), (pose, "pose"), (image, "image"), (raw, "hex")]:
        page.wait(f"{stream} as {kind}", lambda: page.get(card(stream), "data-kind") == kind)
    pixel = ("const c = arguments[0]; return c.width !== 160 ? null :"
             " [...c.getContext('2d').getImageData(40, 30, 1, 1).data]")
    grey = [70, 70, 70, 255]
    page.wait("the image", lambda: page.run(pixel, page.one(card(image) + " canvas")) == grey)
    drawn = ("const c = arguments[0];"
             " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
             " let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 200; return n > 100")
    for stream in [scan, pose]:
        page.wait(f"{stream} is drawn", lambda: page.run(drawn, page.one(card(stream) + " canvas")))
    page.wait("bytes", lambda: "000000  de ad be ef" in page.one(card(raw)).text)
    page.shot("views-light")
    # The only pose places the scan, as long as a person does not choose otherwise.
    place = f"{card(scan)} select[aria-label^='Pose']"
    page.wait("the place", lambda: f"Auto: {pose}" in page.one(place).text)
    page.wait("its trail", lambda: page.get(card(scan), "data-trail-points") == "50")
    page.choose(place, "nothing")
    page.wait("the choice in the link", lambda: urllib.parse.quote('"place":""')
              in page.driver.current_url)
    page.wait("no trail", lambda: page.get(card(scan), "data-trail-points") == "0")
    page.driver.refresh()
    page.await_connected()
    page.wait("still nothing", lambda: page.get(place, "value") == "")
    page.choose(f"{card(scan)} select[aria-label^='Kind']", "Table")
    page.wait("all fields", lambda: "first_rad" in page.one(card(scan)).text)
    page.show_as(DESKTOP, "dark")
    page.wait("dark", lambda: page.run("return document.documentElement.dataset.theme") == "dark")
    page.shot("views-dark")
    # Of a link to what has changed since: the scan without the place, and a kind that fits.
    page.open("views", views=[{"stream": scan, "place": raw}, {"stream": pose, "kind": "scan"},
                              {"stream": image}])
    page.wait("a scan that is not placed", lambda: f"{raw}: its type has no fields of a pose; "
              "the scan is not placed" in page.one(card(scan)).text)
    page.wait("a pose", lambda: page.get(card(pose), "data-kind") == "pose")
    check_touch(page, pose)


def check_touch(page, stream):
    """On the plan view of `stream`, a finger scrolls the page, and two zoom the view."""
    page.show_as(PHONE, "light")
    page.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled",
                                {"enabled": True, "maxTouchPoints": 2})
    page.driver.refresh()
    page.await_connected()
    page.wait("a sample", lambda: page.get(card(stream), "data-tid"))
    page.press(" ")
    settled(page, [stream])
    page.wait("its trail", lambda: page.get(card(stream), "data-trail-points") == "50")
    canvas = card(stream) + " canvas"

    def touch(kind, *points):
        page.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {
            "type": kind, "touchPoints": [
                {"id": i, "x": x, "y": y} for i, (x, y) in enumerate(points)]})

    def swipe(*ways):
        """Moves a finger in each of these directions, away from the middle of the view."""
        x, y = page.run("const {left, top, width, height} = arguments[0].getBoundingClientRect();"
                        "return [left + width / 2, top + height / 2]", page.one(canvas))
        for px in range(20, 120, 10):
            points = [(x + u * px, y + v * px) for u, v in ways]
            touch("touchStart" if px == 20 else "touchMove", *points)
        touch("touchEnd")

    picture = "return arguments[0].toDataURL()"
    page.run("arguments[0].scrollIntoView({block: 'center'})", page.one(canvas))
    before, top = page.run(picture, page.one(canvas)), page.run("return scrollY")
    swipe((0, 1))
    page.wait("the page scrolls", lambda: page.run("return scrollY") < top - 40)
    # The browser scrolls at once, and tells the view afterwards that the finger is not its own.
    page.wait("the view as before", lambda: page.run(picture, page.one(canvas)) == before)
    swipe((1, 0), (-1, 0))
    page.wait("the view zooms", lambda: page.run(picture, page.one(canvas)) != before)
    assert page.run("return visualViewport.scale") == 1, "the page zooms with the view"
    page.shot("views-touch")


def drive(page, scan, pose):
    """The scans of a drive are placed by their poses, also in the past."""
    page.show_as((1280, 600), "light")  # the picture of docs/view.png
    page.open("views", views=[{"stream": scan, "place": pose}, {"stream": pose, "trail": 60}])
    page.wait("scans", lambda: int(page.get(card(scan), "data-tid") or -1) > 150)
    page.press(" ")
    page.run("const slider = document.getElementById('slider');"
             "slider.value = Math.round(0.95 * Number(slider.max));"
             "slider.dispatchEvent(new Event('input'))")
    settled(page, [scan, pose])
    page.wait("the pose of the scan", lambda: page.get(card(scan), "data-tid") ==
              page.get(card(pose), "data-tid"))
    for stream in [scan, pose]:
        page.wait("the trail", lambda: int(page.get(card(stream), "data-trail-points") or 0) > 50)
    page.shot("drive")
    page.show_as((940, 600), "light")
    titles = page.run("return [...document.querySelectorAll('.card h3')].map((h) => h.clientWidth)")
    assert min(titles) > 30, f"a card has no title: {titles}"


def host_down(page, host, stream):
    """Prints "ready" when `host` with `stream` is up, and ends when all pages show that it is down."""
    page.open("views", views=[{"stream": stream}], signals={"panels": [[[stream, "watts"]]]})
    page.wait("a sample", lambda: page.get(card(stream), "data-tid"))
    say("ready")
    mark = f"host {host} is down"
    page.wait("it in the view", lambda: mark in page.one(card(stream)).text)
    page.shot("host-down-views")
    page.press("2")
    page.wait("it in the legend", lambda: mark in page.one(".legend").text)
    page.press("1")
    row = f"#hosts tr[data-host='{host}']"
    page.wait("down", lambda: page.get(row, "data-state") == "down")
    page.wait("the event", lambda: f"host {host} is down" in page.one("#events").text)
    page.wait("why there is no stream", lambda: page.one("#no-streams").text ==
              f"No stream is known. Host {host} is down: its streams are not listed.")
    page.wait("it in the graph", lambda: any(
        title.get_attribute("textContent").endswith(f" on {host}, host down")
        for title in page.all("#graph .stream title")))
    assert f"{stream} is gone" not in page.one("#events").text, page.one("#events").text
    page.shot("host-down")


def reconnect(page):
    """Prints "ready", "lost" when the page shows that, and ends when it is connected again."""
    page.may_report = ["WebSocket connection to"]
    page.open("overview")
    page.wait("hosts", lambda: page.all("#hosts tr[data-host='pc1']"))
    say("ready")
    page.wait("lost", lambda: page.get("#connection", "data-state") == "lost")
    page.wait("a notice", lambda: "No connection to dssm-view" in page.one("#banner").text)
    page.shot("lost")
    say("lost")
    page.await_connected()
    page.wait("no notice", lambda: not page.one("#banner").is_displayed())
    page.wait("it goes on", lambda: page.get("#hosts tr[data-host='pc2']", "data-state") == "up")


def phone(page, stream):
    """No page is wider than a phone."""
    page.show_as(PHONE, "light")
    for tab in ["overview", "signals", "views"]:
        page.open(tab)
        ready = {"overview": stream_row(stream), "signals": ".legend li",
                 "views": ".card[data-kind]"}
        page.wait(f"what {tab} shows", lambda: page.all(ready[tab]))
        page.wait("the graph", lambda: tab != "overview" or page.all("#graph svg"))
        page.shot(f"{tab}-phone")
        width, window = page.run("return [document.documentElement.scrollWidth, innerWidth]")
        assert width <= PHONE[0] == window, f"{tab}: {width} of {window} pixels wide"
    page.press("?")
    page.wait("the keys", lambda: page.one("#keys").is_displayed())
    assert page.run("return document.documentElement.scrollWidth") <= PHONE[0]


def recording(page, stream, late, oldest_ns, newest_ns):
    """A recording with `stream` begins held at its first sample, and plays to its last one; `late`
    begins 1.2 s later, and has a sample each 0.1 s."""
    page.open("overview")
    row = page.wait(stream, lambda: page.one(stream_row(stream)))
    assert "recorded" in row.text, row.text
    for group in ["#hosts-group", "#graph-group"]:
        assert not page.one(group).is_displayed(), "a recording has no hosts and programs"
    assert "it touched something" in page.one("#events").text
    page.shot("recording-overview")
    page.open("signals", signals={"span": 10, "panels": [[[stream, "x_m"]]]})
    page.wait("the first sample", lambda: page.get("#time", "data-t-ns") == oldest_ns)
    assert not page.one("#live").is_displayed()
    def play_at(rate):
        page.run("const rate = document.querySelector('#rate');"
                 "rate.value = arguments[0]; rate.dispatchEvent(new Event('change'))", rate)

    play_at("1")  # so slow that it does not end before it is held
    page.press("r")
    page.wait("it plays", lambda: page.get("#time", "data-mode") == "play")
    page.wait("it goes on", lambda: int(page.get("#time", "data-t-ns")) > int(oldest_ns) + 10**9)
    page.press(" ")
    held = page.wait("it is held", lambda: page.get("#time", "data-mode") == "hold"
                     and page.get("#time", "data-t-ns"))
    assert int(oldest_ns) < int(held) < int(newest_ns), held
    page.shot("recording-signals")
    play_at("50")
    page.press(" ")
    page.wait("its end", lambda: page.get("#time", "data-mode") == "hold"
              and page.get("#time", "data-t-ns") == newest_ns)
    page.open("views", views=[{"stream": late}])
    page.wait("the first sample", lambda: page.get("#time", "data-t-ns") == oldest_ns)
    page.wait("when it begins", lambda: page.one(card(late)).text.count("begins 1.20 s later") == 1)
    assert "too old" not in page.one(card(late)).text
    for key, ms in [(Keys.ARROW_RIGHT, 1200), (Keys.ARROW_RIGHT, 1300), (Keys.ARROW_LEFT, 1200)]:
        t = str(int(oldest_ns) + ms * 10**6)
        page.press(key)
        page.wait(f"a step to {ms} ms", lambda: page.get("#time", "data-t-ns") == t)


CHECKS = {check.__name__: check for check in
          [overview, signal, axes, slider, oldest, oldest_live, absent, described_later, pictures,
           recreated, link, export, save, views, drive, host_down, reconnect, phone, recording]}


def main(check, url, folder, *arguments):
    os.makedirs(folder, exist_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        page = Page(url, folder, profile)
        try:
            CHECKS[check](page, *arguments)
        finally:
            messages = page.close()
    assert not messages, "in the browser's console: " + "\n".join(messages)
    say("ok")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except AssertionError as error:
        sys.exit(f"page.py {sys.argv[1]}: {error}")

"""Pages of episodes: they need nothing else, are small, and show in a browser what was recorded."""

import base64
import io
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs import tiny_model
from gymnasium import spaces
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

from sb3_have import watch
from sb3_have.evaluation.recording import Recording
from sb3_have.plotting import write_page
from sb3_have.plotting.episode import images

T = 12
ACTIONS = ("throttle", "steering")
SENSORS = {"rgb": (16, 16, 3), "event": (16, 16, 5), "depth": (16, 16, 1)}


def a_recording() -> Recording:
    """RGB turns from black to white; the twins take turns in having the lower H."""
    rng = np.random.default_rng(0)
    observations = [
        {name: np.full(shape, 20 * t if name == "rgb" else 128 + t, np.uint8) for name, shape in SENSORS.items()}
        for t in range(T)
    ]
    weights = dict(zip(SENSORS, rng.dirichlet(np.ones(3), T).T, strict=True))
    values = {name: rng.normal(scale=9, size=(2, T)) for name in ("q", "q_global", "q_lve")}
    values["q_local"] = rng.normal(scale=9, size=(2, 3, T))
    return Recording(
        "HardRainNight",
        seconds=0.05,
        observations=observations,
        weights=weights,
        infos=[{"speed": speed} for speed in rng.uniform(0, 30, T)],
        end={"distance": 12.3, "end_reason": "crash"},
        actions=rng.uniform(-1, 1, (T, 2)),
        rewards=rng.normal(size=T),
        values=values,
    )


def episode(page: Path) -> Any:
    """The data in a page."""
    block = re.search(r'<script type="application/json" id="episode">(.*?)</script>', page.read_text(), re.S)
    assert block is not None
    return json.loads(block[1])


def titles(page: Path) -> list[str]:
    return [panel["title"] for panel in episode(page)["panels"]]


def test_page_of_three_noisy_sensors_is_small_and_needs_nothing_else(tmp_path: Path) -> None:
    """Write a twentieth of the worst case, which is 500 steps of noise at 64 pixels."""
    rng, recording = np.random.default_rng(0), Recording("", 0.2, infos=[{}] * 25)
    for _ in recording.infos:
        noise = {name: rng.integers(0, 256, (64, 64, shape[-1]), np.uint8) for name, shape in SENSORS.items()}
        recording.observations.append(noise)
    write_page(recording, tmp_path / "drive.html")
    page = (tmp_path / "drive.html").read_text()
    assert len(page) < 6e6 / 20
    assert "://" not in page and "default-src 'none'" in page
    assert set(re.findall(r'(?:src|href)="([^"]*)"', page)) == {"data:,"}
    assert [path.name for path in tmp_path.iterdir()] == ["drive.html"]


def test_pictures_are_those_of_the_sensors(tmp_path: Path) -> None:
    rng, recording = np.random.default_rng(0), Recording("", 0.2, infos=[{}] * 2)
    for value in (90, 160):
        observation = {name: rng.integers(120, 137, shape, np.uint8) for name, shape in SENSORS.items()}
        observation["rgb"] = np.clip(rng.normal(value, 5, (64, 64, 3)), 0, 255).astype(np.uint8)
        recording.observations.append({**observation, "state": np.zeros(4)})
    recording.pictures = [np.full((480, 640, 3), 77, np.uint8)] * 2
    write_page(recording, tmp_path / "drive.html")
    series = {image["name"]: image for image in episode(tmp_path / "drive.html")["images"]}
    assert list(series) == ["environment", "rgb", "event", "depth"]
    for step in (0, 1):
        shown = {
            name: Image.open(io.BytesIO(base64.b64decode(image["frames"][step]))).convert("RGB")
            for name, image in series.items()
        }
        seen = images(recording.observations[step])
        np.testing.assert_array_equal(shown["event"], seen["event"])
        np.testing.assert_array_equal(shown["depth"], seen["depth"])
        rgb = np.asarray(shown["rgb"].resize((64, 64), Image.Resampling.BOX)).astype(float)
        assert np.sqrt(np.mean((rgb - seen["rgb"]) ** 2)) < 6
        assert shown["environment"].size == (320, 240)


def test_parts_that_were_not_recorded_are_left_out(tmp_path: Path) -> None:
    page = tmp_path / "drive.html"
    write_page(a_recording(), page, ACTIONS)
    rest = ["throttle", "steering", "reward"]
    assert titles(page) == ["weight of each modality", "value of the action", "speed", *rest]
    recording = a_recording()
    recording.weights, recording.values, recording.observations, recording.infos = {}, {}, [], [{}] * T
    write_page(recording, page)
    assert titles(page) == ["action", "reward"] and episode(page)["images"] == []
    write_page(Recording("", None, infos=[{}]), page)
    assert titles(page) == [] and episode(page)["facts"] == {"steps": "1"}


def test_text_of_a_recording_cannot_become_part_of_the_page(tmp_path: Path) -> None:
    recording = a_recording()
    recording.weather = weather = "</script><!--<script>alert(1)"
    write_page(recording, tmp_path / "drive.html")
    assert episode(tmp_path / "drive.html")["weather"] == weather
    assert (tmp_path / "drive.html").read_text().count("<script") == 2


def test_numbers_that_json_does_not_have(tmp_path: Path) -> None:
    recording = a_recording()
    recording.values["q"][:, 3], recording.rewards[4], recording.infos[5] = np.nan, -np.inf, {}
    write_page(recording, tmp_path / "drive.html")
    panels = {panel["title"]: panel["curves"][-1]["values"] for panel in episode(tmp_path / "drive.html")["panels"]}
    missing = {title: [t for t, value in enumerate(values) if value is None] for title, values in panels.items()}
    assert missing == {
        "weight of each modality": [],
        "value of the action": [3],
        "speed": [5],
        "action": [],
        "reward": [4],
    }


def test_what_cannot_be_shown(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="empty"):
        write_page(Recording("", 0.2), tmp_path / "drive.html")
    with pytest.raises(ValueError, match="actions: expected 2 names, got"):
        write_page(a_recording(), tmp_path / "drive.html", ["throttle"])
    assert not list(tmp_path.iterdir())


def test_command_line_names_the_actions_of_the_highway(tmp_path: Path) -> None:
    tiny_model(spaces.Dict({"rgb": spaces.Box(0, 255, (36, 36, 3), np.uint8)})).save(tmp_path / "model")
    page = tmp_path / "drive.html"
    watch.main([str(tmp_path / "model"), "--out", str(page), "--steps", "2", "--weather", "WetNoon"])
    assert titles(page)[-3:] == ["throttle (negative brakes)", "steering (positive turns right)", "reward"]
    assert episode(page)["weather"] == "WetNoon" and len(episode(page)["images"][0]["frames"]) == 2


# ---- in a browser ----

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS.split(), f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options, webdriver.ChromeService(driver))
    chrome.set_script_timeout(3600)
    yield chrome
    chrome.quit()


@pytest.fixture
def page(browser: webdriver.Chrome, tmp_path: Path) -> Iterator[webdriver.Chrome]:
    """A browser that displays the recording, and does not complain about anything in the page."""
    write_page(a_recording(), tmp_path / "drive.html", ACTIONS)
    browser.get((tmp_path / "drive.html").as_uri())
    yield browser
    assert browser.get_log("browser") == []  # type: ignore[no-untyped-call]


def shown_step(page: webdriver.Chrome) -> int:
    return int(page.find_element(By.ID, "slider").get_property("value"))  # type: ignore[arg-type]


def colour(page: webdriver.Chrome) -> int:
    """Red of the first picture, once it is loaded."""
    script = """
        const [picture, done] = [document.querySelector("img"), arguments[0]];
        picture.decode().then(() => {
          const canvas = document.createElement("canvas").getContext("2d");
          canvas.drawImage(picture, 0, 0);
          done(canvas.getImageData(5, 5, 1, 1).data[0]);
        });"""
    return int(page.execute_async_script(script))


def numbers(element: WebElement) -> dict[str, str]:
    """Label and number of each curve in the legend of a panel."""
    entries = element.find_elements(By.CSS_SELECTOR, ".legend div")
    return {
        str(entry.find_element(By.TAG_NAME, "dt").text): entry.find_element(By.TAG_NAME, "dd").text for entry in entries
    }


def panel(page: webdriver.Chrome, title: str) -> WebElement:
    return page.find_element(By.CSS_SELECTOR, f'section[aria-label="{title}"]')


def press(page: webdriver.Chrome, key: str) -> None:
    ActionChains(page).send_keys(key).perform()


def assert_shows(text: str, value: float, unit: str = "") -> None:
    """Compare a text with a recorded number, at the precision of the text."""
    number = re.fullmatch(rf"−?\d+\.(\d+){unit}", text)
    assert number is not None, text
    digits = len(number[1])
    assert text == f"{round(float(value), digits) + 0.0:.{digits}f}{unit}".replace("-", "−")


@pytest.mark.parametrize("step", [0, 5, T - 1])
def test_numbers_are_those_of_the_recording(page: webdriver.Chrome, step: int) -> None:
    page.execute_script("slider.value = arguments[0]; slider.dispatchEvent(new Event('input'))", step)
    recording = a_recording()
    values, twin = recording.values, int(recording.values["q"][:, step].argmin())
    weights = numbers(panel(page, "weight of each modality"))
    captions = [caption.text.split("\n") for caption in page.find_elements(By.TAG_NAME, "figcaption")]
    assert captions == [[name, weight] for name, weight in weights.items()]
    for name in SENSORS:
        assert_shows(weights[name], 100 * recording.weights[name][step], " %")
    expected = {f"local: {name}": values["q_local"][twin, i, step] for i, name in enumerate(SENSORS)}
    for key, label in (("q_global", "global"), ("q_lve", "weighted local"), ("q", "H, re-fusion of both")):
        expected[label] = values[key][twin, step]
    texts = numbers(panel(page, "value of the action"))
    assert list(texts) == list(expected)
    for label, value in expected.items():
        assert_shows(texts[label], value)
    assert_shows(numbers(panel(page, "speed"))[""], recording.infos[step]["speed"], " m/s")
    for i, name in enumerate(ACTIONS):
        assert_shows(numbers(panel(page, name))[""], recording.actions[step, i])
    assert_shows(numbers(panel(page, "reward"))[""], recording.rewards[step])
    assert page.find_element(By.TAG_NAME, "output").text == f"{0.05 * step:.2f} s / 0.55 s"
    assert colour(page) == 20 * step


def test_curves_and_cursor_lie_at_the_numbers(page: webdriver.Chrome) -> None:
    """The dots are computed for each step, and the lines of the curves pass through them."""
    speeds = [info["speed"] for info in a_recording().infos]
    chart = panel(page, "speed").find_element(By.CLASS_NAME, "chart")
    line = str(chart.find_element(By.TAG_NAME, "path").get_attribute("d"))
    points = np.array([[float(number) for number in point.split()] for point in re.split("[ML]", line)[1:]])
    np.testing.assert_array_equal(points[:, 0], np.arange(T))
    slope, _ = np.polyfit(speeds, points[:, 1], 1)
    assert slope < 0 and np.corrcoef(speeds, points[:, 1])[0, 1] < -0.9999
    for key, step in ((Keys.END, T - 1), (Keys.ARROW_LEFT, T - 2)):
        press(page, key)
        dot, cursor = (chart.find_element(By.CLASS_NAME, name) for name in ("dot", "cursor"))
        x, y = (
            float(page.execute_script(f"return parseFloat(arguments[0].style.{side})", dot)) for side in ("left", "top")
        )
        assert (x, y) == pytest.approx((100 * step / (T - 1), points[step, 1]), abs=0.01)
        assert page.execute_script("return parseFloat(arguments[0].style.left)", cursor) == pytest.approx(x)


def test_keyboard_moves_slider_and_frame(page: webdriver.Chrome) -> None:
    assert (shown_step(page), colour(page)) == (0, 0)
    keys = [
        (Keys.ARROW_RIGHT, 1),
        (Keys.ARROW_RIGHT, 2),
        (Keys.ARROW_LEFT, 1),
        (Keys.END, T - 1),
        (Keys.ARROW_RIGHT, T - 1),
        (Keys.HOME, 0),
        (Keys.ARROW_LEFT, 0),
    ]
    for focus in ("body", "#slider", "#play"):
        page.execute_script(f"document.activeElement.blur(); document.querySelector('{focus}').focus()")
        for key, step in keys:
            press(page, key)
            assert (shown_step(page), colour(page)) == (step, 20 * step), (focus, key)
    page.get(f"{page.current_url}#7")
    page.refresh()
    assert (shown_step(page), colour(page)) == (7, 140), "the address names a step"
    press(page, Keys.HOME)
    for name, step in (("Next step", 1), ("Next step", 2), ("Previous step", 1)):
        page.find_element(By.CSS_SELECTOR, f'[aria-label="{name}"]').click()
        assert shown_step(page) == step
    press(page, " ")  # on the last of these buttons
    assert shown_step(page) == 0 and page.find_element(By.ID, "play").accessible_name == "Play"


@pytest.mark.parametrize("focus", ["body", "#slider", "#play"])
def test_playing_ends_with_the_episode_and_starts_it_again(page: webdriver.Chrome, focus: str) -> None:
    button, wait = page.find_element(By.ID, "play"), WebDriverWait(page, 3600, poll_frequency=0.02)
    page.execute_script("window.steps = []; views.push((step) => steps.push(step))")
    page.execute_script(f"document.querySelector('{focus}').focus()")
    for _ in range(2):
        press(page, " ")
        wait.until(lambda _: shown_step(page) == T - 1 and button.accessible_name == "Play")
    steps = page.execute_script("return steps")
    again = steps.index(0)
    for played in (steps[:again], steps[again:]):
        assert played == sorted(set(played)) and len(played) > 1 and played[-1] == T - 1


def test_pause(page: webdriver.Chrome, tmp_path: Path) -> None:
    recording = a_recording()
    recording.seconds = 1000.0
    write_page(recording, tmp_path / "slow.html")
    page.get((tmp_path / "slow.html").as_uri())
    button = page.find_element(By.ID, "play")
    button.click()
    press(page, Keys.ESCAPE)
    for stop in (button.click, lambda: press(page, " "), lambda: press(page, Keys.ARROW_RIGHT)):
        assert button.accessible_name == "Pause" and page.execute_script("return playing !== null")
        stop()
        assert button.accessible_name == "Play" and page.execute_script("return playing === null")
        press(page, " ")
    assert shown_step(page) == 1


def test_values_below_the_pointer_and_dragging(page: webdriver.Chrome) -> None:
    section = panel(page, "throttle")
    chart, box = section.find_element(By.CLASS_NAME, "chart"), section.find_element(By.CLASS_NAME, "hover")
    assert not box.is_displayed()
    step, last = 8, T - 1
    x = round((step / last - 0.5) * chart.size["width"])
    pointer = ActionChains(page, duration=0).move_to_element_with_offset(chart, x, 0)
    pointer.perform()
    time, throttle = box.text.split("\n")
    assert time == f"{0.05 * step:.2f} s" and shown_step(page) == 0
    assert_shows(throttle, a_recording().actions[step, 0])
    pointer.click().perform()
    assert (shown_step(page), colour(page)) == (step, 20 * step)
    outside = -x - chart.size["width"] // 2 - 9
    pointer.click_and_hold().move_by_offset(-5, 0).move_by_offset(outside, 0).release().perform()
    assert shown_step(page) == 0
    ActionChains(page, duration=0).move_to_element(page.find_element(By.TAG_NAME, "h1")).perform()
    assert not box.is_displayed()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_narrow_screens_and_colours(page: webdriver.Chrome, scheme: str) -> None:
    size = {"width": 360, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    preference = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", preference)
    assert page.execute_script("return document.documentElement.scrollWidth") <= 360
    right = "return Math.max(...[...document.querySelectorAll('main *')].map((e) => e.getBoundingClientRect().right))"
    assert page.execute_script(right) <= 360
    chart = panel(page, "value of the action").find_element(By.CLASS_NAME, "chart")
    ActionChains(page, duration=0).move_to_element_with_offset(chart, -5, 0).perform()
    assert chart.find_element(By.CLASS_NAME, "hover").is_displayed()
    assert page.execute_script("return document.documentElement.scrollWidth") <= 360
    tops = {picture.location["y"] for picture in page.find_elements(By.TAG_NAME, "img")}
    assert len(tops) == 1, "side by side"
    ground, ink = (
        sum(map(int, re.findall(r"\d+", page.find_element(By.TAG_NAME, "body").value_of_css_property(name))[:3]))
        for name in ("background-color", "color")
    )
    assert ground - ink > 500 if scheme == "light" else ink - ground > 500
    page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_page_of_almost_nothing(page: webdriver.Chrome, tmp_path: Path) -> None:
    write_page(
        Recording("", None, infos=[{}], actions=np.ones((1, 1)), rewards=np.full(1, np.nan)), tmp_path / "a.html"
    )
    page.get((tmp_path / "a.html").as_uri())
    assert page.find_element(By.TAG_NAME, "h1").text == "Episode" and not page.find_elements(By.TAG_NAME, "img")
    assert numbers(panel(page, "action"))["action 0"].startswith("1.0") and numbers(panel(page, "reward")) == {"": "–"}
    press(page, " ")
    assert page.find_element(By.TAG_NAME, "output").text == "step 0 / 0"


def test_frame_of_another_page_becomes_as_high_as_the_page(page: webdriver.Chrome, tmp_path: Path) -> None:
    html = (tmp_path / "drive.html").read_text()
    page.get("about:blank")
    page.execute_script(
        "const frame = document.createElement('iframe'); frame.srcdoc = arguments[0];"
        "frame.style = 'width: 740px; border: 0';"
        "document.body.append(frame)",
        html,
    )
    frame = page.find_element(By.TAG_NAME, "iframe")
    inside = (
        "const inside = arguments[0].contentDocument.documentElement; return [inside.scrollHeight, inside.clientWidth]"
    )
    WebDriverWait(page, 60).until(lambda _: frame.size["height"] > 500)
    assert page.execute_script(inside, frame) == [frame.size["height"], 740], "no scroll bar"

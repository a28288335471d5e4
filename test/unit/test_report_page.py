from contextlib import contextmanager
from dataclasses import replace
import json
import re
import shutil

import cv2
import numpy as np
import pytest
from test_figures import a_map, a_panorama, a_run

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.report import (
    drive_page,
    FrameStrip,
    panoramas,
    write_report,
    write_video,
)
from landmark_nav.evaluation.report.collect import page_html
from landmark_nav.evaluation.run_report import pose_report, spells
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.types import CameraFrame, Candidate, Refusal

_FLAGS = (
    *('headless', 'no-sandbox', 'disable-gpu', 'disable-quic', 'no-first-run', 'disable-sync'),
    *('disable-background-networking', 'disable-component-update'),
)


@contextmanager
def browser(profile):
    """Return a Selenium driver; skip the test where Chromium or its driver is absent."""
    webdriver = pytest.importorskip('selenium.webdriver')
    binary = shutil.which('chromium') or shutil.which('google-chrome')
    driver = shutil.which('chromedriver')
    if binary is None or driver is None:
        pytest.skip('no chromium with chromedriver: apt-get install chromium chromium-driver')
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (*_FLAGS, f'user-data-dir={profile}'):
        options.add_argument(f'--{flag}')
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        chrome.set_script_timeout(20)
        yield chrome
    finally:
        chrome.quit()


CAMERA = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)
MOUNT = PanTiltMount(axis_xyz=(0.1, 0.0, 1.2))
# What a bag, a file or a message may hold.
HOSTILE = '</script><script>window.hacked=1</script><img src=x onerror="window.hacked=1">'
INPUTS = {'bag': HOSTILE}


def page_of(truth=True, camera=True, **given):
    """Page of a run that sees landmark 1 in every image, with panoramas."""
    run, landmarks, strip = a_run(truth), a_map(), FrameStrip()
    rng = np.random.default_rng(0)
    updates = []
    for update in run.updates:
        if camera:
            image = rng.integers(0, 256, (120, 160)).astype(np.uint8)
            strip.add(CameraFrame(update.stamp_ns, image, CAMERA, -1.5))
        one = np.ones(1)
        found = replace(
            update.observation.detections, ids=np.array([1]), bearing_rad=-1.5 * one,
            variance_rad2=1e-6 * one, score=0.9 * one, uv_px=np.array([[80.0, 60.0]]),
        )  # fmt: skip
        refused = {2: Refusal('low correlation', HOSTILE)}
        observation = replace(update.observation, detections=found, refused=refused)
        reason = HOSTILE if update.status == 'lost' else ''
        updates.append(replace(update, observation=observation, reason=reason))
    run = replace(run, updates=tuple(updates))
    report = {**pose_report(run, landmarks), 'spells': spells(run)}
    page = drive_page(
        report, run, given.pop('landmarks', landmarks),
        Calibration.of_mount(MOUNT), strip,
    )  # fmt: skip
    candidates = (Candidate(100.0, 40.0, 20, 20, 1.0), Candidate(399.0, 40.0, 20, 20, 0.5))
    outcomes = (landmarks.landmarks[1], Refusal('too far', HOSTILE))
    learned = LearningResult(landmarks, (a_panorama(),), (candidates,), (outcomes,), 2)
    page['data']['panoramas'] = panoramas(learned)
    return page


@pytest.fixture(scope='module')
def chrome(tmp_path_factory):
    with browser(tmp_path_factory.mktemp('profile')) as driver:
        yield driver


@pytest.fixture
def opened(chrome, tmp_path):
    """Return a function that opens a page, at a width, and checks that its script had no error."""

    def load(page, width=1200, dark=False, title='a drive'):
        write_report(tmp_path / 'page.html', page, title, 'landmark-nav evaluate', INPUTS)
        size = {'width': width, 'height': 900, 'deviceScaleFactor': 1, 'mobile': width < 600}
        chrome.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', size)
        feature = {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'}
        chrome.execute_cdp_cmd('Emulation.setEmulatedMedia', {'features': [feature]})
        chrome.get((tmp_path / 'page.html').as_uri())
        assert chrome.get_log('browser') == []
        return chrome

    return load


def robot_at(chrome):
    """Where the plan shows the robot, metres."""
    text = chrome.execute_script(
        "return document.querySelector('#robot').getAttribute('transform')"
    )
    x, y = map(float, re.match(r'translate\((\S+) (\S+)\)', text).groups())
    return x / 100.0, -y / 100.0


# Widths of all images that a selector finds, once they are decoded.
WIDTHS = """
    const done = arguments[1];
    Promise.all([...document.querySelectorAll(arguments[0])].map((one) => {
      const image = new Image();
      image.src = one.getAttribute('src') || one.getAttribute('href');
      return image.decode().then(() => image.naturalWidth);
    })).then(done, () => done([]))
"""


def click(chrome, selector):
    event = "new MouseEvent('click', {bubbles: true})"
    chrome.execute_script(f'document.querySelector(arguments[0]).dispatchEvent({event})', selector)


def press(chrome, key, **more):
    event = json.dumps({'key': key, 'bubbles': True, 'cancelable': True, **more})
    chrome.execute_script(f"document.body.dispatchEvent(new KeyboardEvent('keydown', {event}))")


def test_the_slider_moves_the_robot_and_every_image_loads(opened):
    page = page_of()
    chrome = opened(page)
    poses = page['data']['run']['pose']
    for k in (0, 10, 29):
        chrome.execute_script(
            "const s = document.getElementById('time'); s.value = arguments[0];"
            "s.dispatchEvent(new Event('input'))",
            k,
        )
        assert robot_at(chrome) == pytest.approx(poses[k][:2], abs=1e-6)
        size = chrome.execute_async_script(
            "const done = arguments[0], image = document.getElementById('camera');"
            'image.decode().then(() => done([image.naturalWidth, image.naturalHeight]))'
        )
        assert size == [160, 120]
    click(chrome, '#plan [data-id]')
    loaded = chrome.execute_async_script(WIDTHS, 'img, image')
    assert len(loaded) == 3  # camera, patch, panorama
    assert all(loaded)
    assert chrome.get_log('browser') == []


def test_what_comes_from_outside_is_text(opened):
    chrome = opened(page_of(), title=HOSTILE)
    press(chrome, 'End')
    click(chrome, '[data-candidate="1"]')
    shown = chrome.execute_script('return document.body.innerText + document.title')
    assert shown.count(HOSTILE) >= 5  # heading, state, seen, panorama, table, title
    assert chrome.execute_script('return window.hacked') is None
    assert chrome.execute_script("return document.querySelectorAll('script').length") == 2


@pytest.mark.parametrize(
    'given',
    [
        {'truth': False},
        {'camera': False},
        {'landmarks': replace(a_map(), walls=(), panorama_poses=())},
        {'landmarks': replace(a_map(0), walls=())},
    ],
)
def test_pages_work_whatever_is_missing(opened, given):
    chrome = opened(page_of(**given))
    press(chrome, 'End')
    assert np.isfinite(robot_at(chrome)).all()
    assert chrome.get_log('browser') == []


def test_a_page_needs_no_network_and_holds_no_number_that_is_none():
    html = page_html(page_of(truth=False), 'a drive', 'landmark-nav evaluate', INPUTS)
    assert not re.search(r'(?:src|href)="(?!data:)', html)
    json.loads(
        re.search(r'id="data">(.*?)</script>', html, re.DOTALL).group(1),
        parse_constant=pytest.fail,
    )


@pytest.mark.parametrize('count', [7, 40, 333])
def test_images_of_a_long_drive_are_thinned_evenly_to_a_budget(count):
    rng = np.random.default_rng(1)
    strip = FrameStrip(60_000)
    for k in range(count):
        image = rng.integers(0, 256, (60, 80)).astype(np.uint8)
        strip.add(CameraFrame(k, image, CAMERA, 0.0))
    assert sum(map(len, strip.jpegs.values())) <= 60_000
    assert len(set(np.diff(list(strip.jpegs)))) == 1
    assert len(strip.frames) == count
    assert max(strip.jpegs) + 2 * np.diff(list(strip.jpegs))[0] > count - 1


@pytest.mark.parametrize('camera', [True, False])
def test_a_video_shows_the_drive(tmp_path, camera):
    write_video(tmp_path / 'drive.mp4', page_of(camera=camera))
    video = cv2.VideoCapture(str(tmp_path / 'drive.mp4'))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    frames = [video.read()[1][:, :800].astype(int) for _ in range(count)]
    assert len(frames) == 30
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0, rel=0.01)
    # The robot goes on: what differs between two frames lies farther and farther to the right.
    moved = [np.abs(frames[k] - frames[k + 2]).sum((0, 2)) for k in (2, 12, 22)]
    middles = [float(np.average(np.arange(800), weights=one > 500)) for one in moved]
    assert middles == sorted(middles)


@pytest.mark.parametrize('dark', [False, True])
def test_on_a_phone_nothing_is_cut(opened, dark):
    chrome = opened(page_of(), 390, dark, 'a_bag_with_a_name_' * 8)
    wide = chrome.execute_script(
        'return [...document.querySelectorAll("body *")].filter((one) => !one.closest("svg") &&'
        'one.getClientRects().length && one.getBoundingClientRect().right > 390.5)'
        '.map((one) => one.outerHTML.slice(0, 80))'
    )
    assert wide == []
    assert chrome.execute_script('return document.documentElement.scrollWidth') <= 390


def test_figures_follow_dark_mode(opened):
    read = (
        'const of = (name) => getComputedStyle(document.querySelector(name));'
        'return [of("body").backgroundColor, of(".plan").backgroundColor,'
        'of("#charts .line").stroke, of("#charts text").fill]'
    )
    light, dark = (opened(page_of(), dark=dark).execute_script(read) for dark in (False, True))
    assert all(one != other for one, other in zip(light, dark, strict=True))
